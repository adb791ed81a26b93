"""What a run leaves: its folder, records, checkpoints and result, and policies that act, evaluate and are exported."""
