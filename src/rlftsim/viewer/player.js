"use strict";
// Plays the scenes of a page. Every figure.player holds its data as JSON and one canvas for each panel; the panels of a
// figure share time and view.
(() => {
  const STEP_S = 0.1, HOLD_AT_END_S = 1.0;
  const VEHICLE = 1, PEDESTRIAN = 2, CYCLIST = 3;
  const TYPE_NAMES = { 1: "vehicle", 2: "pedestrian", 3: "cyclist" };
  const ROLE_NAMES = ["other", "evaluated", "ego"], EGO = 2;
  const LIGHT_COLORS = { 1: "stop", 4: "stop", 7: "stop", 2: "caution", 5: "caution", 8: "caution", 3: "go", 6: "go" };
  const POLYGONS = ["crosswalk", "speed_bump", "driveway"];

  // ---- data -------------------------------------------------------------------------------------------------------

  function decodeSeries(second, length) {
    const values = new Float32Array(length);
    let value = 0, slope = 0;
    for (let i = 0; i < length; i++) {
      const d = i < second.length ? second[i] : 0;
      if (i === 0) value = d;
      else { slope = i === 1 ? d : slope + d; value += slope; }
      values[i] = value / 100;
    }
    return values;
  }

  function decodeFlags(intervals, length) {
    const flags = new Uint8Array(length);
    for (let i = 0; i < intervals.length; i += 2) flags.fill(1, intervals[i], intervals[i + 1]);
    return flags;
  }

  function decodeAgent([x, y, heading, valid, collides, offroad], steps) {
    return {
      x: decodeSeries(x, steps), y: decodeSeries(y, steps), heading: decodeSeries(heading, steps),
      valid: decodeFlags(valid, steps), collides: decodeFlags(collides, steps), offroad: decodeFlags(offroad, steps),
    };
  }

  function decodePoints(differences) {
    const points = [];
    let x = 0, y = 0;
    for (let i = 0; i < differences.length; i += 2) {
      x += differences[i]; y += differences[i + 1];
      points.push([x / 100, y / 100]);
    }
    return points;
  }

  function tracePath(path, points, close) {
    points.forEach(([x, y], i) => (i ? path.lineTo(x, y) : path.moveTo(x, y)));
    if (close) path.closePath();
  }

  function buildMap(kinds) {
    const map = {};
    for (const [kind, lines] of Object.entries(kinds)) {
      const path = new Path2D();
      for (const line of lines) tracePath(path, decodePoints(line), POLYGONS.includes(kind));
      map[kind] = path;
    }
    map.stop_points = (kinds.stop_sign || []).map((line) => decodePoints(line)[0]);
    return map;
  }

  function futurePath(agent, from, steps) {
    const path = new Path2D();
    let drawing = false;
    for (let i = from; i < steps; i++) {
      if (!agent.valid[i]) { drawing = false; continue; }
      if (drawing) path.lineTo(agent.x[i], agent.y[i]); else path.moveTo(agent.x[i], agent.y[i]);
      drawing = true;
    }
    return path;
  }

  // ---- drawing ----------------------------------------------------------------------------------------------------

  function readColors(element) {
    const style = getComputedStyle(element);
    return new Proxy({}, { get: (cache, name) => (cache[name] ??= style.getPropertyValue(`--${name}`).trim()) });
  }

  function drawMap(ctx, map, colors, px) {
    const stroke = (kind, color, width, dash = []) => {
      if (!map[kind]) return;
      ctx.strokeStyle = color; ctx.lineWidth = width; ctx.setLineDash(dash); ctx.stroke(map[kind]);
    };
    const fill = (kind, color) => { if (map[kind]) { ctx.fillStyle = color; ctx.fill(map[kind]); } };
    ctx.lineCap = "round"; ctx.lineJoin = "round";
    fill("driveway", colors.road);
    stroke("lane", colors.road, 4.4);
    stroke("bike_lane", colors.road, 2);
    stroke("lane", colors["lane-center"], px);
    stroke("bike_lane", colors["lane-center"], px);
    for (const kind of ["crosswalk", "speed_bump"]) {
      fill(kind, colors.crosswalk);
      stroke(kind, colors["crosswalk-outline"], px, [0.6, 0.6]);
    }
    ctx.lineCap = "butt";
    stroke("white", colors["line-white"], 1.2 * px);
    stroke("white_broken", colors["line-white"], 1.2 * px, [1.5, 2.5]);
    stroke("yellow", colors["line-yellow"], 1.2 * px);
    stroke("yellow_broken", colors["line-yellow"], 1.2 * px, [1.5, 2.5]);
    stroke("edge", colors.edge, 1.6 * px);
    ctx.setLineDash([]);
    for (const [x, y] of map.stop_points) {
      ctx.beginPath();
      for (let i = 0; i < 8; i++) {
        const a = Math.PI / 8 + (i * Math.PI) / 4;
        ctx.lineTo(x + 6 * px * Math.cos(a), y + 6 * px * Math.sin(a));
      }
      ctx.closePath(); ctx.fillStyle = colors.stop; ctx.fill();
      ctx.fillStyle = colors.surface; ctx.fillRect(x - 3.5 * px, y - 0.9 * px, 7 * px, 1.8 * px);
    }
  }

  function drawLights(ctx, lights, step, colors, px) {
    for (const [x, y, states] of lights) {
      const name = LIGHT_COLORS[states[Math.min(step, states.length - 1)]];
      ctx.beginPath(); ctx.arc(x / 100, y / 100, 4 * px, 0, 2 * Math.PI);
      ctx.fillStyle = name ? colors[name] : colors.surface;
      ctx.strokeStyle = colors["light-ring"]; ctx.lineWidth = 1.5 * px;
      ctx.fill(); ctx.stroke();
    }
  }

  function stateAt(agent, time) {
    const step = Math.min(Math.floor(time), agent.x.length - 1), next = Math.min(step + 1, agent.x.length - 1);
    if (!agent.valid[step]) return null;
    const share = agent.valid[next] ? time - step : 0;
    const mix = (values) => values[step] + (values[next] - values[step]) * share;
    const back = agent.valid[step - 1] ? step - 1 : step, ahead = agent.valid[next] ? next : step;
    const distance = Math.hypot(agent.x[ahead] - agent.x[back], agent.y[ahead] - agent.y[back]);
    return {
      x: mix(agent.x), y: mix(agent.y), heading: mix(agent.heading),
      speed: ahead > back ? distance / ((ahead - back) * STEP_S) : 0,
      collides: agent.collides[step], offroad: agent.offroad[step],
    };
  }

  function traceShape(ctx, type, half, halfWidth) {
    ctx.beginPath();
    if (type === PEDESTRIAN) ctx.arc(0, 0, Math.max(half, halfWidth), 0, 2 * Math.PI);
    else if (type === CYCLIST) ctx.ellipse(0, 0, half, halfWidth, 0, 0, 2 * Math.PI);
    else ctx.roundRect(-half, -halfWidth, 2 * half, 2 * halfWidth, 0.3 * halfWidth);
  }

  function drawAgent(ctx, state, box, colors, px, hovered) {
    const [, type, length, width, role] = box;
    const small = type === PEDESTRIAN ? 3.2 : type === CYCLIST ? 2.4 : 2;
    const half = Math.max(length / 200, (type === CYCLIST ? 2 : 1) * small * px), halfWidth = Math.max(width / 200, small * px);
    ctx.save();
    ctx.translate(state.x, state.y); ctx.rotate(state.heading);
    const ring = (gap, color, dash) => {
      traceShape(ctx, type, half + gap * px, halfWidth + gap * px);
      ctx.fillStyle = ctx.strokeStyle = color; ctx.lineWidth = 2 * px;
      ctx.globalAlpha = 0.3; ctx.fill(); ctx.globalAlpha = 1;
      ctx.setLineDash(dash); ctx.stroke(); ctx.setLineDash([]);
    };
    if (state.offroad) ring(state.collides ? 8 : 4, colors.offroad, [3 * px, 2 * px]);
    if (state.collides) ring(4, colors.collision, []);
    traceShape(ctx, type, half, halfWidth);
    ctx.fillStyle = colors[`agent-${ROLE_NAMES[role]}`];
    ctx.fill();
    ctx.strokeStyle = hovered ? colors.ink : colors["agent-outline"]; ctx.lineWidth = (hovered ? 2 : 0.8) * px; ctx.stroke();
    // the heading mark: a wedge that points ahead, outside the disc of a pedestrian
    const tip = type === PEDESTRIAN ? half * 1.9 : half * 0.88, root = type === PEDESTRIAN ? half * 0.9 : half * 0.3;
    const spread = type === PEDESTRIAN ? half * 0.7 : halfWidth * 0.66;
    ctx.beginPath(); ctx.moveTo(tip, 0); ctx.lineTo(root, spread); ctx.lineTo(root, -spread); ctx.closePath();
    if (type !== PEDESTRIAN) ctx.fillStyle = colors["heading-mark"];
    ctx.fill();
    ctx.restore();
  }

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
      this.time = data.scene.now; this.rollout = 0; this.speed = 1; this.showAll = true;
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
      if (this.time >= this.steps - 1) this.time = 0;
      this.last = performance.now();
      requestAnimationFrame((stamp) => this.tick(stamp));
    }

    tick(stamp) {
      if (!this.playing) return;
      const elapsed = Math.min(Math.max((stamp - this.last) / 1000, 0), 0.25);
      this.last = stamp;
      if (this.time < this.steps - 1) this.seek(this.time + (elapsed * this.speed) / STEP_S);
      else if ((this.held += elapsed) > HOLD_AT_END_S) { this.held = 0; this.seek(0); }
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
})();
