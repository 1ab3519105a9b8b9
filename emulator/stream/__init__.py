"""The stream to observers: its messages, live and from a finished run, and playback in wall-clock time."""
