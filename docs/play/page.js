"use strict";
// The ball on the page: a click or a tap gives the policy another goal.

(async () => {
  const canvas = document.getElementById("arena"), told = document.getElementById("told");
  const act = PLAY.policy(await (await fetch("policy.json")).json());
  const half = 0.3, paint = canvas.getContext("2d");
  let ball = [0, 0, 0, 0], goal = [0.15, 0.1], force = [0, 0], count = 0, owed = 0, before = null;

  const pixel = (x, y) => [((x + half) / (2 * half)) * canvas.width, ((half - y) / (2 * half)) * canvas.height];

  function disc(place, radius, colour) {
    paint.beginPath();
    paint.arc(...pixel(...place), (radius / (2 * half)) * canvas.width, 0, 2 * Math.PI);
    paint.fillStyle = colour;
    paint.fill();
  }

  function draw() {
    paint.fillStyle = "#2b5d8f";
    paint.fillRect(0, 0, canvas.width, canvas.height);
    const [left, top] = pixel(-0.2, 0.2), side = (0.4 / (2 * half)) * canvas.width;
    paint.strokeStyle = "rgba(255, 255, 255, 0.35)";
    paint.strokeRect(left, top, side, side);
    disc(goal, 0.015, "#e07a6d");
    disc(ball, 0.01, "#f4c77b");
    const [x, y] = pixel(...ball);
    paint.strokeStyle = "#fff";
    paint.beginPath();
    paint.moveTo(x, y);
    paint.lineTo(x + 40 * force[0], y - 40 * force[1]);
    paint.stroke();
    const where = `goal (${goal.map((z) => z.toFixed(2)).join(", ")}) m`;
    const beyond = goal.some((z) => Math.abs(z) > 0.2) ? ", outside the goals of training" : "";
    told.textContent = `${where}${beyond}; reward of a step ${PLAY.reward(ball, goal).toFixed(2)}`;
  }

  function frame(now) {
    owed = Math.min(owed + (before === null ? 0 : now - before) / 1000, 0.2);
    before = now;
    for (; owed >= PLAY.SECONDS; owed -= PLAY.SECONDS) {
      if (count++ % PLAY.SUBSTEPS === 0) force = act(ball, goal);
      ball = PLAY.substep(ball, force);
    }
    draw();
    requestAnimationFrame(frame);
  }

  canvas.addEventListener("pointerdown", (event) => {
    const box = canvas.getBoundingClientRect(), within = (z) => Math.min(Math.max(z, -PLAY.WALL), PLAY.WALL);
    const x = ((event.clientX - box.left) / box.width) * 2 * half - half;
    goal = [within(x), within(half - ((event.clientY - box.top) / box.height) * 2 * half)];
  });
  requestAnimationFrame(frame);
})();
