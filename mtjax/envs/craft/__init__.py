"""Grid worlds whose tasks are made of parts: crafts with recipes, rooms with keys and doors, errands in sentences."""
