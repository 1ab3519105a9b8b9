"""The scenario: its file, its sections, its faults as data, and what its seed gives."""
