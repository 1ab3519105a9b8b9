"""The emulated radio: the engine, and the stages that decide every reception's outcome."""
