"""The programs of a run: split over devices, traced, compiled, and cached between runs."""
