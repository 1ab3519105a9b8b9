"""What is kept of a run and how it is judged; everything here can be redone from the run's folder."""
