"""The terminal: errors in one line, live picture, plain lines, JSON, and the summary of a run."""
