"""The radio validated against ns-3: the same vehicles, sending at the same instants, in both."""
