"""The emulated radio: the engine, and the stages that decide the outcome of every reception."""
