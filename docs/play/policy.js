"use strict";
// Acts by a policy of mtjax in JavaScript: what docs/make_play.py writes is the program that mtjax.export writes, a list
// of operations by their names in JAX, with its constants. Arrays are { shape, data }; observations are vectors.

const PLAY = (() => {
  const size = (shape) => shape.reduce((a, b) => a * b, 1);
  const same = (a, b) => a.length === b.length && a.every((n, i) => n === b[i]);
  const refuse = (text) => { throw new Error(text); };

  // An operation on every entry; a single number goes with all entries of another array.
  const each = (f) => (xs) => {
    const longest = xs.reduce((a, b) => (b.data.length > a.data.length ? b : a));
    const fits = xs.every((x) => x.data.length === 1 || same(x.shape, longest.shape));
    if (!fits) refuse(`shapes ${xs.map((x) => `[${x.shape}]`).join(" and ")} do not go together`);
    const at = (x, i) => x.data[x.data.length === 1 ? 0 : i];
    return { shape: longest.shape, data: Array.from(longest.data, (_, i) => f(...xs.map((x) => at(x, i)))) };
  };
  const vector = (data) => ({ shape: [data.length], data });
  const joined = (xs) => vector(xs.flatMap((x) => Array.from(x.data)));
  const reshaped = (x, shape) => ({ shape, data: x.data });

  function product([a, b], { dimension_numbers: [[[ofA], [ofB]], batch] }) {
    const plain = a.shape.length === 1 && b.shape.length === 2 && ofA === 0 && ofB === 0 && !batch.flat().length;
    if (!plain) refuse("a product is of a vector and a matrix");
    const [rows, columns] = b.shape, data = new Array(columns).fill(0);
    for (let i = 0; i < rows; i++) for (let j = 0; j < columns; j++) data[j] += a.data[i] * b.data[i * columns + j];
    return vector(data);
  }

  function split([x], { sizes }) {
    let first = 0;
    return sizes.map((count) => vector(x.data.slice(first, (first += count))));
  }

  const OPERATIONS = {
    add: each((x, y) => x + y),
    sub: each((x, y) => x - y),
    mul: each((x, y) => x * y),
    div: each((x, y) => x / y),
    max: each(Math.max),
    min: each(Math.min),
    neg: each((x) => -x),
    sqrt: each(Math.sqrt),
    square: each((x) => x * x),
    exp: each(Math.exp),
    tanh: each(Math.tanh),
    logistic: each((x) => 1 / (1 + Math.exp(-x))),
    gt: each((x, y) => +(x > y)),
    lt: each((x, y) => +(x < y)),
    select_n: each((which, no, yes) => (which ? yes : no)),
    convert_element_type: ([x]) => x,
    squeeze: ([x], { dimensions }) => reshaped(x, x.shape.filter((_, i) => !dimensions.includes(i))),
    reshape: ([x], { new_sizes }) => reshaped(x, new_sizes),
    broadcast_in_dim: ([x], { shape }) =>
      x.data.length === 1 ? { shape, data: new Array(size(shape)).fill(x.data[0]) }
        : x.data.length === size(shape) ? reshaped(x, shape) : refuse("only a single number is repeated"),
    slice: ([x], { start_indices: [from], limit_indices: [to] }) => vector(x.data.slice(from, to)),
    concatenate: joined,
    stack: joined,
    split,
    dot_general: product,
  };

  function decode({ shape, floats }) {
    const bytes = Uint8Array.from(atob(floats), (letter) => letter.charCodeAt(0));
    return { shape, data: new Float32Array(bytes.buffer) };
  }

  // Return the function from an observation and the task's parameters, which are lists, to the action.
  function policy({ program, constants }) {
    const known = constants.map(decode), unknown = program.steps.find(([name]) => !(name in OPERATIONS));
    if (unknown) refuse(`there is no operation ${unknown[0]} here yet`);
    return (obs, parameters) => {
      const values = [...known, vector(obs), vector(parameters)];
      for (const [name, from, to, settings] of program.steps) {
        const made = OPERATIONS[name](from.map((i) => values[i]), settings);
        to.forEach((place, i) => (values[place] = Array.isArray(made) ? made[i] : made));
      }
      return Array.from(values[program.result].data);
    };
  }

  // The point mass of dm_control: 0.3 kg, motors of 0.1 N, damping of 1 N s/m that is solved for implicitly.
  const MASS = 0.3, GEAR = 0.1, DAMPING = 1, SECONDS = 0.02, SUBSTEPS = 5, WALL = 0.29;

  // Return a ball [x, y, its velocity] after 0.02 s under forces in [-1, 1]. Walls stop it, which MuJoCo does softly.
  function substep([x, y, u, v], force) {
    const move = (place, speed, push) => {
      const pull = GEAR * Math.min(Math.max(push, -1), 1) - DAMPING * speed;
      const next = speed + (SECONDS * pull) / (MASS + SECONDS * DAMPING);
      const there = place + SECONDS * next;
      return Math.abs(there) > WALL ? [Math.sign(there) * WALL, 0] : [there, next];
    };
    const [a, b] = [move(x, u, force[0]), move(y, v, force[1])];
    return [a[0], b[0], a[1], b[1]];
  }

  // Return 1 within 0.015 m of the goal, falling linearly to 0 at 0.41 m from there.
  function reward([x, y], [goalX, goalY]) {
    const beyond = Math.max(Math.hypot(x - goalX, y - goalY) - 0.015, 0);
    return Math.max(1 - beyond / 0.41, 0);
  }

  return { policy, substep, reward, SECONDS, SUBSTEPS, WALL };
})();

if (typeof module !== "undefined") module.exports = PLAY;
