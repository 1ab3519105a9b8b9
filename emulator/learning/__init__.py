"""Learning: a run as an environment of PettingZoo, whose agents are vehicles."""
