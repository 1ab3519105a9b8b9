"""The radio held to ns-3: the same vehicles, sending at the same instants, in both."""
