"""The rules of the craft world, of the rooms and of the errands again, in plain Python, with a search for plans."""

from collections import deque

STEPS = ((0, -1), (0, 1), (-1, 0), (1, 0))  # down, up, left, right
USE, STOP = 4, 5
ENVIRONMENT = ("boundary", "water", "stone", "workshop 0", "workshop 1", "workshop 2")
RECIPES = {
    "workshop 0": (("plank", "wood"), ("axe", "stick", "iron"), ("rope", "grass")),
    "workshop 1": (("stick", "wood"), ("bed", "plank", "grass"), ("shears", "stick", "iron")),
    "workshop 2": (("cloth", "grass"), ("bridge", "wood", "iron"), ("ladder", "plank", "stick")),
}
SKETCHES = {
    "plank": "get-wood make-at-0",
    "stick": "get-wood make-at-1",
    "cloth": "get-grass make-at-2",
    "rope": "get-grass make-at-0",
    "bridge": "get-iron get-wood make-at-2",
    "bed": "get-wood make-at-0 get-grass make-at-1",
    "axe": "get-wood make-at-1 get-iron make-at-0",
    "shears": "get-wood make-at-1 get-iron make-at-1",
    "gold": "get-iron get-wood make-at-2 get-gold",
    "gem": "get-wood make-at-1 get-iron make-at-0 get-gem",
}


class Craft:
    """A grid of things by their names, and a walker in it."""

    def __init__(self, things, place):
        self.things = dict(things)  # (x, y) -> name; empty cells are not in it
        self.place, self.facing, self.held = tuple(place), 0, {}

    def ahead(self):
        dx, dy = STEPS[self.facing]
        return self.place[0] + dx, self.place[1] + dy

    def count(self, item):
        return self.held.get(item, 0)

    def add(self, item, count):
        self.held[item] = self.count(item) + count

    def step(self, action):
        if action < USE:
            self.facing = action
            if self.ahead() not in self.things:
                self.place = self.ahead()
        if action == USE:
            self.use(self.things.get(self.ahead()))

    def use(self, thing):
        if thing in RECIPES:
            for product, *inputs in RECIPES[thing]:
                if all(self.count(item) for item in inputs):
                    self.add(product, 1)
                    for item in inputs:
                        self.add(item, -1)
        elif thing == "water" and self.count("bridge"):
            self.add("bridge", -1)
            del self.things[self.ahead()]
        elif thing == "stone" and self.count("axe"):
            del self.things[self.ahead()]
        elif thing is not None and thing not in ENVIRONMENT:
            self.add(thing, 1)
            del self.things[self.ahead()]

    def way_to(self, cells):
        """The shortest moves after which the walker faces one of the cells; None if no free way leads there."""
        queue, before = deque([(self.place, self.facing)]), {(self.place, self.facing): None}
        while queue:
            state = queue.popleft()
            (x, y), facing = state
            if (x + STEPS[facing][0], y + STEPS[facing][1]) in cells:
                return moves_back(before, state)
            for action, (dx, dy) in enumerate(STEPS):
                after = ((x, y) if (x + dx, y + dy) in self.things else (x + dx, y + dy), action)
                if after not in before:
                    before[after] = (state, action)
                    queue.append(after)
        return None

    def cells_of(self, name):
        return {cell for cell, thing in self.things.items() if thing == name}

    def carry_out(self, symbol):
        """Do what a symbol stands for, and return the actions."""
        verb, _, what = symbol.partition("-")
        target = f"workshop {what[-1]}" if verb == "make" else what
        actions = []
        treasure = self.cells_of(target) if target in ("gold", "gem") else set()
        if treasure and self.way_to(treasure) is None:
            actions += self.go_and_use(self.cells_of({"gold": "water", "gem": "stone"}[target]) & around(*treasure))
        return actions + self.go_and_use(self.cells_of(target))

    def go_and_use(self, cells):
        actions = [*self.way_to(cells), USE]
        for action in actions:
            self.step(action)
        return actions


def around(cell):
    return {(cell[0] + dx, cell[1] + dy) for dx, dy in STEPS}


def moves_back(before, state):
    """The actions that led to a state."""
    actions = []
    while before[state] is not None:
        state, action = before[state]
        actions.append(action)
    return actions[::-1]


class Rooms:
    """Rooms of six cells from wall to wall, doors as {place: key's place, or None if it is open}, and a walker."""

    def __init__(self, place, doors, goal):
        self.place, self.doors, self.goal = tuple(place), dict(doors), tuple(goal)

    def room(self):
        return self.place[0] // 6, self.place[1] // 6

    def step(self, action):
        if action == USE:
            self.doors = {door: None if key == self.place else key for door, key in self.doors.items()}
        elif action < USE:
            x, y = self.place[0] + STEPS[action][0], self.place[1] + STEPS[action][1]
            if self.doors[x, y] is None if (x, y) in self.doors else x % 6 and y % 6:
                self.place = x, y

    def lights(self):
        """Twelve numbers: locked doors, open doors and keys, each to the left, to the right, below and above."""
        seen = {"locked": [0.0] * 4, "open": [0.0] * 4, "key": [0.0] * 4}
        inside = self.place[0] % 6 and self.place[1] % 6
        for door, key in self.doors.items():
            rooms = {((door[0] + i) // 6, (door[1] + j) // 6) for i in (-1, 1) for j in (-1, 1)}
            if door == self.place or (inside and self.room() in rooms):
                self.shine(seen["open" if key is None else "locked"], door)
            if key is not None and inside and (key[0] // 6, key[1] // 6) == self.room():
                self.shine(seen["key"], key)
        return [*seen["locked"], *seen["open"], *seen["key"]]

    def shine(self, sums, light):
        dx, dy = light[0] - self.place[0], light[1] - self.place[1]
        bright = max(0.0, 1 - (dx * dx + dy * dy) ** 0.5 / 10)
        for i, there in enumerate((dx <= 0, dx >= 0, dy <= 0, dy >= 0)):
            sums[i] += bright * there

    def carry_out(self, symbol):
        """Go to the next room in a direction by the fewest actions, keys included, and return them."""
        dx, dy = STEPS[("down", "up", "left", "right").index(symbol)]
        room = self.room()[0] + dx, self.room()[1] + dy
        begun = self.place, tuple(self.doors.items())
        queue, before = deque([begun]), {begun: None}
        while queue:
            state = queue.popleft()
            self.place, self.doors = state[0], dict(state[1])
            if self.room() == room and self.place[0] % 6 and self.place[1] % 6:
                return moves_back(before, state)
            for action in range(5):
                self.place, self.doors = state[0], dict(state[1])
                self.step(action)
                after = self.place, tuple(self.doors.items())
                if after not in before:
                    before[after] = (state, action)
                    queue.append(after)
        raise AssertionError(f"no way leads {symbol}")
