"""Grid worlds: crafts with recipes, rooms with keys and doors, errands in sentences, and colours that cost."""
