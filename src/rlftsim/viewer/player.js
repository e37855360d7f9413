// Plays the scenes of a page. Every figure.player holds its data as JSON and one canvas for each panel; the panels of a
// figure share time and view. `drawing.js` stands before it in the same function.
const HOLD_AT_END_S = 1.0;

class Panel {
  constructor(element, trajectories, player) {
    this.player = player;
    this.canvas = element.querySelector("canvas");
    this.ctx = this.canvas.getContext("2d");
    this.status = element.querySelector(".panel-status");
    this.tip = element.querySelector(".panel-tip");
    this.steps = trajectories.steps;
    this.marks = trajectories.marks;
    this.rollouts = trajectories.rollouts.map((agents) => agents.map((a) => decodeAgent(a, trajectories.steps)));
    const { agents, now } = player.scene;
    this.fans = this.rollouts.map((rollout) => rollout.map((a, i) => (agents[i][4] ? futurePath(a, now, this.steps) : null)));
  }

  get shown() { return Math.min(this.player.rollout, this.rollouts.length - 1); }

  get scale() { return Math.min(this.canvas.clientWidth, this.canvas.clientHeight) / (2 * this.player.view.r); }

  toWorld(event) {
    const box = this.canvas.getBoundingClientRect(), k = this.scale, view = this.player.view;
    return [view.x + (event.clientX - box.left - box.width / 2) / k, view.y - (event.clientY - box.top - box.height / 2) / k];
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(this.canvas.clientWidth * ratio);
    this.canvas.height = Math.round(this.canvas.clientHeight * ratio);
  }

  draw(colors) {
    const { ctx, canvas, player } = this, { view, scene, time } = player;
    const ratio = canvas.width / Math.max(canvas.clientWidth, 1), k = this.scale * ratio, px = 1 / this.scale;
    ctx.setTransform(1, 0, 0, 1, 0, 0);
    ctx.fillStyle = colors.ground; ctx.fillRect(0, 0, canvas.width, canvas.height);
    ctx.setTransform(k, 0, 0, -k, canvas.width / 2 - k * view.x, canvas.height / 2 + k * view.y);
    drawMap(ctx, player.map, colors, px);
    this.drawPaths(colors, px);
    drawLights(ctx, scene.lights, Math.floor(time), colors, px);
    this.drawAgents(colors, px);
    this.drawStatus();
  }

  drawPaths(colors, px) {
    const { ctx, player } = this, agents = player.scene.agents;
    const strokeAll = (n, alpha, width) => this.fans[n].forEach((path, i) => {
      if (!path) return;
      ctx.globalAlpha = alpha; ctx.lineWidth = width * px;
      ctx.strokeStyle = colors[`agent-${ROLE_NAMES[agents[i][4]]}`]; ctx.stroke(path);
    });
    ctx.lineCap = "round";
    if (player.showAll) for (let n = 0; n < this.rollouts.length; n++) if (n !== this.shown) strokeAll(n, 0.4, 1);
    strokeAll(this.shown, 0.75, 2);
    ctx.globalAlpha = 1;
  }

  drawAgents(colors, px) {
    const { ctx, player } = this, { scene, time, hovered } = player, rollout = this.rollouts[this.shown];
    this.states = rollout.map((agent) => stateAt(agent, time));
    for (const role of [0, 1, 2]) {
      this.states.forEach((state, i) => {
        if (state && scene.agents[i][4] === role) drawAgent(ctx, state, scene.agents[i], colors, px, hovered === i);
      });
    }
  }

  drawStatus() {
    const { now } = this.player.scene, step = Math.floor(this.player.time), rollout = this.rollouts[this.shown];
    const soFar = (name) => rollout.filter((a) => a[name].subarray(now + 1, step + 1).includes(1)).length;
    const parts = [];
    if (this.steps <= step) parts.push("log ends here");
    if (this.marks[0]) parts.push(`<b>${soFar("collides")}</b> collided`);
    if (this.marks[1]) parts.push(`<b>${soFar("offroad")}</b> off road`);
    const text = parts.join(" · ");
    if (text !== this.statusText) this.status.innerHTML = this.statusText = text;
  }

  nearest([x, y]) {
    let best = -1, least = Math.max(2.5, 14 / this.scale);
    (this.states || []).forEach((state, i) => {
      const distance = state ? Math.hypot(state.x - x, state.y - y) : Infinity;
      if (distance < least) { least = distance; best = i; }
    });
    return best;
  }

  describe(index) {
    const state = index >= 0 && this.states && this.states[index];
    this.tip.hidden = !state;
    if (!state) return;
    const [id, type, , , role] = this.player.scene.agents[index];
    const kind = TYPE_NAMES[type] || "object", suffix = role ? ` · ${ROLE_NAMES[role]}` : "";
    this.tip.textContent = `${kind} ${id}${suffix} · ${state.speed.toFixed(1)} m/s`;
  }
}

// ---- control ----------------------------------------------------------------------------------------------------

class Player {
  constructor(root) {
    this.root = root;
    const data = JSON.parse(root.querySelector("script[type='application/json']").textContent);
    this.scene = data.scene;
    this.map = buildMap(data.scene.map);
    this.first = Number(root.dataset.first ?? 0);
    this.time = Number(root.dataset.first ?? data.scene.now); this.rollout = 0; this.speed = 1; this.showAll = true;
    this.playing = false; this.hovered = -1; this.held = 0;
    this.resetView();
    this.panels = [...root.querySelectorAll(".panel")].map((element, i) => new Panel(element, data.panels[i], this));
    this.steps = Math.max(...this.panels.map((p) => p.steps));
    this.numRollouts = Math.max(...this.panels.map((p) => p.rollouts.length));
    this.bindControls();
    this.panels.forEach((panel) => this.bindPanel(panel));
    new ResizeObserver(() => { this.panels.forEach((p) => p.resize()); this.draw(); }).observe(root);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.colors = null; this.draw(); });
  }

  resetView() { const [x, y, r] = this.scene.focus; this.view = { x, y, r }; }

  find(name) { return this.root.querySelector(`[data-part='${name}']`); }

  bindControls() {
    this.slider = this.find("time"); this.slider.max = this.steps - 1;
    this.slider.style.setProperty("--now", this.scene.now / (this.steps - 1));
    this.slider.addEventListener("input", () => { this.toggle(false); this.seek(Number(this.slider.value)); });
    this.find("play").addEventListener("click", () => this.toggle());
    this.find("speed").addEventListener("change", (event) => { this.speed = Number(event.target.value); });
    this.find("all").addEventListener("change", (event) => { this.showAll = event.target.checked; this.draw(); });
    this.find("zoom-in").addEventListener("click", () => this.zoom(1 / 1.4));
    this.find("zoom-out").addEventListener("click", () => this.zoom(1.4));
    this.find("reset").addEventListener("click", () => { this.resetView(); this.draw(); });
    const chooser = this.find("rollout");
    for (let n = 0; n < this.numRollouts; n++) chooser.add(new Option(`${n + 1} of ${this.numRollouts}`, n));
    chooser.addEventListener("change", () => { this.rollout = Number(chooser.value); this.draw(); });
    this.root.querySelectorAll(".several").forEach((element) => { element.hidden = this.numRollouts < 2; });
    this.root.addEventListener("keydown", (event) => this.onKey(event));
  }

  onKey(event) {
    if (event.target.matches("select, button, input[type='checkbox']") && event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
    const moves = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity };
    if (event.key === " ") this.toggle();
    else if (event.key in moves) { this.toggle(false); this.seek(Math.round(this.time) + moves[event.key]); }
    else if (event.key === "+" || event.key === "=") this.zoom(1 / 1.4);
    else if (event.key === "-") this.zoom(1.4);
    else return;
    event.preventDefault();
  }

  bindPanel(panel) {
    const { canvas } = panel, fingers = new Map();
    const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY); };
    canvas.addEventListener("pointerdown", (event) => { fingers.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); this.root.focus({ preventScroll: true }); });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return this.hover(panel.nearest(panel.toWorld(event)));
      if (fingers.size === 1) this.pan((last.clientX - event.clientX) / panel.scale, (event.clientY - last.clientY) / panel.scale);
      const before = fingers.size === 2 ? spread() : 0;
      fingers.set(event.pointerId, event);
      if (before) this.zoom(before / Math.max(spread(), 1));
    });
    canvas.addEventListener("pointerleave", () => this.hover(-1));
    canvas.addEventListener("wheel", (event) => {
      // The wheel scrolls the page until the figure is clicked; Ctrl or a pinch always zooms.
      if (!event.ctrlKey && !this.root.contains(document.activeElement)) return;
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), panel.toWorld(event));
    }, { passive: false });
  }

  hover(index) {
    if (index === this.hovered) return;
    this.hovered = index; this.draw();
  }

  pan(dx, dy) { this.view.x += dx; this.view.y += dy; this.draw(); }

  zoom(factor, [x, y] = [this.view.x, this.view.y]) {
    const { view } = this, r = Math.min(Math.max(view.r * factor, 6), 400), share = r / view.r;
    this.view = { x: x + (view.x - x) * share, y: y + (view.y - y) * share, r };
    this.draw();
  }

  seek(time) { this.time = Math.min(Math.max(time, 0), this.steps - 1); this.draw(); }

  toggle(playing = !this.playing) {
    if (playing === this.playing) return;
    this.playing = playing; this.held = 0;
    const button = this.find("play");
    button.setAttribute("aria-label", playing ? "Pause" : "Play");
    button.classList.toggle("playing", playing);
    if (!playing) return;
    if (this.time >= this.steps - 1) this.time = this.first;
    this.last = performance.now();
    requestAnimationFrame((stamp) => this.tick(stamp));
  }

  tick(stamp) {
    if (!this.playing) return;
    const elapsed = Math.min(Math.max((stamp - this.last) / 1000, 0), 0.25);
    this.last = stamp;
    if (this.time < this.steps - 1) this.seek(this.time + (elapsed * this.speed) / STEP_S);
    else if ((this.held += elapsed) > HOLD_AT_END_S) { this.held = 0; this.seek(this.first); }
    requestAnimationFrame((next) => this.tick(next));
  }

  draw() {
    this.colors ??= readColors(this.root);
    for (const panel of this.panels) { panel.draw(this.colors); panel.describe(this.hovered); }
    const seconds = (this.time - this.scene.now) * STEP_S, distance = Math.round(10 * seconds);
    this.slider.value = this.time;
    this.find("clock").textContent = `${seconds < -0.04 ? "−" : "+"}${Math.abs(seconds).toFixed(1)} s`;
    this.find("phase").textContent = distance < 0 ? "history" : distance ? "future" : "now";
    this.root.dataset.step = Math.floor(this.time);
  }
}

for (const root of document.querySelectorAll("figure.player")) root.player = new Player(root);
