"""What a run is on disk: its folder, its records and its policies."""
