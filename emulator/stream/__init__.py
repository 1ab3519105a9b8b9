"""The stream to observers: its messages, live and from a finished run."""
