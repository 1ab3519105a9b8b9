"""The stream to observers: the messages, the same from a finished run, and the pace in which they come."""
