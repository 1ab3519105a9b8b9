"""The channel: the stages that a (frame, receiver) pair passes, and the outcomes it can have."""
