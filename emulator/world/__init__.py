"""The truth that the vehicles live in and never see: where they are, and how wrong their GNSS is."""
