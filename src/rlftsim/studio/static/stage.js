// One panel: a canvas that copies a still layer (map and trails) and draws what moves on top of it.
import { contextOf } from "./dom.js";
import { CYCLIST, PEDESTRIAN, ROLE_NAMES, STEP_S, TYPE_NAMES, drawAgent, drawLights, drawMap, stateAt } from "./drawing.js";
import { goalOf, ownGoals, state } from "./state.js";

const NEAR_M = 2.0;
const PIN_PX = 9, SLOW_FRAME_MS = 25, MEASURED_FRAMES = 10;
const MANEUVER_NAMES = { left: "left", right: "right", straight: "straight", left_uturn: "U-turn", lane_change_left: "lane left", lane_change_right: "lane right" };
const maneuverName = (name) => MANEUVER_NAMES[name] || name;

/** The map of the present view, drawn once for all panels of one size. */
class Ground {
  constructor() { this.layer = document.createElement("canvas"); this.key = ""; }

  get(width, height, ratio, scale, px, colors, onCpu) {
    const { x, y } = state.view, key = [state.split, state.id, width, height, x, y, scale, px, colors.ground, onCpu].join();
    if (key === this.key) return this.layer;
    this.key = key;
    if (this.onCpu !== onCpu) { this.onCpu = onCpu; this.layer = document.createElement("canvas"); }
    this.layer.width = width; this.layer.height = height;
    const ctx = contextOf(this.layer, { onCpu }), k = scale * ratio;
    ctx.fillStyle = colors.ground; ctx.fillRect(0, 0, width, height);
    ctx.setTransform(k, 0, 0, -k, width / 2 - k * x, height / 2 + k * y);
    if (state.map) drawMap(ctx, state.map, colors, px);
    return this.layer;
  }
}

class Panel {
  constructor(element, stage) {
    this.element = element; this.stage = stage;
    this.frame = element.querySelector(".frame");
    this.status = element.querySelector(".panel-status");
    this.tip = element.querySelector(".panel-tip");
    this.empty = element.querySelector(".panel-empty");
    this.still = document.createElement("canvas");
    this.stillKey = "";
    this.makeCanvas();
  }

  /** A new canvas: a context keeps its kind of memory for ever. */
  makeCanvas() {
    const canvas = document.createElement("canvas");
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    this.canvas?.remove();
    this.frame.prepend(canvas);
    this.canvas = canvas;
    this.ctx = contextOf(canvas, { onCpu: this.stage.onCpu, alpha: false });
    if (this.stage.onCpu) this.still = document.createElement("canvas");
    this.stillCtx = contextOf(this.still, { onCpu: this.stage.onCpu, alpha: false });
    this.stillKey = "";
    this.resize();
    this.stage.bind(this);
  }

  get key() { return state.panels[this.stage.panels.indexOf(this)]; }

  /** Rollouts to be drawn: those of the variant, or the log as the only one. */
  get rollouts() {
    if (this.key === "log") return state.log ? [state.log.agents] : [];
    return state.variants.get(this.key)?.rollouts ?? [];
  }

  get shown() { return Math.min(state.rollout, this.rollouts.length - 1); }

  /** Lines and pins grow with the text of large screens. */
  get grown() { return this.status.currentCSSZoom || 1; }

  get scale() { return Math.min(this.canvas.clientWidth, this.canvas.clientHeight) / (2 * state.view.r) || 1; }

  toWorld(event) {
    const box = this.canvas.getBoundingClientRect(), k = this.scale;
    return [state.view.x + (event.clientX - box.left - box.width / 2) / k, state.view.y - (event.clientY - box.top - box.height / 2) / k];
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    this.stillKey = "";
  }

  draw(colors) {
    const { ctx, canvas } = this;
    if (!state.scene || canvas.width < 2) return;
    const ratio = canvas.width / Math.max(canvas.clientWidth, 1), k = this.scale * ratio, px = this.grown / this.scale;
    /** @type {[number, number, number, number, number, number]} */
    this.transform = [k, 0, 0, -k, canvas.width / 2 - k * state.view.x, canvas.height / 2 + k * state.view.y];
    this.drawStill(colors, ratio, px);
    ctx.setTransform(1, 0, 0, 1, 0, 0);
    ctx.drawImage(this.still, 0, 0);
    ctx.setTransform(...this.transform);
    drawLights(ctx, state.scene.lights, Math.floor(state.time), colors, px);
    if (state.showAll && this.rollouts.length > 1) this.drawGhosts(colors);
    this.drawAgents(colors, px);
    this.drawPins(colors, px, ratio);
    this.drawTexts();
  }

  // ---- the still layer ----------------------------------------------------------------------------------------------

  drawStill(colors, ratio, px) {
    const { canvas, stillCtx } = this, variant = state.variants.get(this.key);
    const key = [
      this.stage.viewKey(), canvas.width, canvas.height, colors.ground, this.key, variant?.version, this.shown, state.showAll, state.trails,
      state.selected, ownGoals().map((goal) => goal.agent).join("+"),
    ].join();
    if (key === this.stillKey) return;
    this.stillKey = key;
    const ground = this.stage.ground.get(canvas.width, canvas.height, ratio, this.scale, px, colors, this.stage.onCpu);
    if (this.still.width !== canvas.width || this.still.height !== canvas.height) { this.still.width = canvas.width; this.still.height = canvas.height; }
    stillCtx.setTransform(1, 0, 0, 1, 0, 0);
    stillCtx.drawImage(ground, 0, 0);
    stillCtx.setTransform(...this.transform);
    if (state.trails) this.drawTrails(stillCtx, colors, px);
    this.drawEnds(stillCtx, colors, px);
  }

  /** Agents whose trails are drawn: evaluated ones, the selected one and those with goals. */
  followed() {
    return state.scene.agents.map(([id, , , , role]) => role > 0 || id === state.selected || goalOf(id) !== undefined);
  }

  drawTrails(ctx, colors, px) {
    const followed = this.followed(), { agents, now } = state.scene, shown = this.shown;
    ctx.lineCap = ctx.lineJoin = "round";
    this.rollouts.forEach((rollout, n) => {
      if (n !== shown && !state.showAll) return;
      for (const role of [0, 1, 2]) {
        const path = new Path2D();
        agents.forEach((box, a) => { if (followed[a] && box[4] === role) traceTrail(path, rollout[a], now); });
        ctx.globalAlpha = n === shown ? 0.8 : 0.3; ctx.lineWidth = (n === shown ? 2.2 : 1) * px;
        ctx.strokeStyle = colors[`agent-${ROLE_NAMES[role]}`];
        ctx.stroke(path);
      }
    });
    ctx.globalAlpha = 1;
  }

  /** End points of the selected agent in all rollouts: where it gets by itself, darker where it ends more often. */
  drawEnds(ctx, colors, px) {
    const index = this.stage.indexOf(state.selected);
    if (index < 0 || this.key === "log") return;
    ctx.fillStyle = colors["series-4"];
    for (const rollout of this.rollouts) {
      const agent = rollout[index], last = agent.valid.lastIndexOf(1);
      for (const [radius, alpha] of [[3.2, 0.06], [1.9, 0.1], [0.8, 0.16]]) {
        ctx.globalAlpha = alpha;
        ctx.beginPath(); ctx.arc(agent.x[last], agent.y[last], Math.max(radius, 3 * px * radius), 0, 2 * Math.PI); ctx.fill();
      }
    }
    ctx.globalAlpha = 1;
  }

  // ---- what moves ---------------------------------------------------------------------------------------------------

  /** Boxes of all rollouts but the shown one: a path and a fill for each agent, as one path across the picture fills slowly. */
  drawGhosts(colors) {
    const { ctx, shown, rollouts } = this, { agents } = state.scene, step = Math.floor(state.time), share = state.time - step;
    ctx.globalAlpha = 0.25;
    for (let a = 0; a < agents.length; a++) {
      const [, , length, width, role] = agents[a], l = length / 200, w = width / 200;
      ctx.beginPath();
      for (let n = 0; n < rollouts.length; n++) {
        const motion = rollouts[n][a];
        if (n === shown || !motion.valid[step]) continue;
        const next = motion.valid[step + 1] ? step + 1 : step;
        const x = motion.x[step] + (motion.x[next] - motion.x[step]) * share, y = motion.y[step] + (motion.y[next] - motion.y[step]) * share;
        const heading = motion.heading[step], lc = l * Math.cos(heading), ls = l * Math.sin(heading), wc = w * Math.cos(heading), ws = w * Math.sin(heading);
        ctx.moveTo(x + lc - ws, y + ls + wc);
        ctx.lineTo(x - lc - ws, y - ls + wc);
        ctx.lineTo(x - lc + ws, y - ls - wc);
        ctx.lineTo(x + lc + ws, y + ls - wc);
        ctx.closePath();
      }
      ctx.fillStyle = colors[`agent-${ROLE_NAMES[role]}`];
      ctx.fill();
    }
    ctx.globalAlpha = 1;
  }

  drawAgents(colors, px) {
    const { ctx } = this, { agents } = state.scene, { hovered, selected, time } = state;
    // Before there are rollouts the panel shows the history, and then the agents where they start.
    const rollout = this.rollouts[this.shown] ?? (state.log && state.log.agents), held = this.rollouts.length ? time : Math.min(time, state.scene.now);
    this.states = rollout ? rollout.map((agent) => stateAt(agent, held)) : [];
    for (const role of [0, 1, 2]) {
      this.states.forEach((one, i) => {
        if (!one || agents[i][4] !== role) return;
        if (agents[i][0] === selected) halo(ctx, one, agents[i], colors.accent, px, 1);
        const loss = state.loss?.get(agents[i][0]);
        if (loss) halo(ctx, one, agents[i], colors.bad, px, loss);
        drawAgent(ctx, one, agents[i], colors, px, hovered === i);
      });
    }
  }

  drawPins(colors, px, ratio) {
    const { ctx } = this;
    if (state.proposals && state.proposals.agent === state.selected) {
      for (const [number, proposal] of state.proposals.proposals.entries()) {
        const goal = goalOf(state.selected), chosen = goal && goal.x === proposal.x && goal.y === proposal.y;
        ctx.strokeStyle = colors["series-4"]; ctx.lineWidth = 1.6 * px; ctx.setLineDash([4 * px, 4 * px]); ctx.globalAlpha = 0.8;
        ctx.beginPath(); proposal.way.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y))); ctx.stroke();
        ctx.setLineDash([]); ctx.globalAlpha = 1;
        if (!chosen) this.pin(...this.stage.toMap(proposal), `${number + 1} ${maneuverName(proposal.maneuver)}`, colors, px, ratio, false);
      }
    }
    for (const goal of ownGoals()) this.pin(...this.stage.toMap(goal), `${goal.agent}${goal.label ? ` ${maneuverName(goal.label.split(" ")[0])}` : ""}`, colors, px, ratio, true);
    if (state.placing) this.pin(state.placing.x, state.placing.y, `${state.placing.agent}?`, colors, px, ratio, true);
  }

  /** A goal or a proposal; an arrow at the border where it lies outside the view. */
  pin(x, y, text, colors, px, ratio, isGoal) {
    const { ctx, canvas } = this, [k, , , , dx, dy] = this.transform, unit = ratio * this.grown, margin = 16 * unit;
    const cx = k * x + dx, cy = -k * y + dy, w = canvas.width, h = canvas.height;
    const ink = isGoal ? colors.surface : colors["series-4"], color = isGoal ? colors["series-4"] : colors.surface;
    ctx.save();
    ctx.setTransform(unit, 0, 0, unit, Math.min(Math.max(cx, margin), w - margin), Math.min(Math.max(cy, margin), h - margin));
    ctx.fillStyle = color; ctx.strokeStyle = isGoal ? colors.surface : colors["series-4"]; ctx.lineWidth = 1.5;
    ctx.beginPath();
    if (cx < 0 || cy < 0 || cx > w || cy > h) {
      ctx.rotate(Math.atan2(cy - h / 2, cx - w / 2));
      ctx.moveTo(PIN_PX + 3, 0); ctx.lineTo(-PIN_PX, PIN_PX - 2); ctx.lineTo(-PIN_PX, 2 - PIN_PX); ctx.closePath(); ctx.fill(); ctx.stroke();
      ctx.restore();
      return;
    }
    ctx.arc(0, 0, PIN_PX - 3, 0, 2 * Math.PI); ctx.fill(); ctx.stroke();
    if (isGoal) { ctx.beginPath(); ctx.arc(0, 0, (NEAR_M * this.scale) / this.grown, 0, 2 * Math.PI); ctx.strokeStyle = colors["series-4"]; ctx.setLineDash([3, 3]); ctx.stroke(); ctx.setLineDash([]); }
    ctx.font = "600 11.5px system-ui, sans-serif"; ctx.textBaseline = "middle";
    const width = ctx.measureText(text).width;
    ctx.fillStyle = color; ctx.beginPath(); ctx.roundRect(9, -9, width + 10, 18, 5); ctx.fill();
    if (!isGoal) { ctx.strokeStyle = colors["series-4"]; ctx.lineWidth = 1; ctx.stroke(); }
    ctx.fillStyle = ink; ctx.fillText(text, 14, 0.5);
    ctx.restore();
  }

  drawTexts() {
    const rollout = this.rollouts[this.shown], { now } = state.scene, step = Math.floor(state.time), variant = state.variants.get(this.key);
    const parts = [];
    if (rollout) {
      const soFar = (name) => rollout.filter((agent) => agent[name]?.subarray(now + 1, step + 1).includes(1)).length;
      const official = this.key === "log" ? null : variant?.score?.score?.official;
      if (official) parts.push(`RMM ${official.metametric.toFixed(3)}`);
      if (this.key === "log" || official) parts.push(`${soFar("collides")} collided`);
      if (official) parts.push(`${soFar("offroad")} off road`);
      if (this.key === "log" && state.log.steps <= step) parts.push("log ends here");
    }
    const text = parts.join(" · ");
    if (text !== this.statusText) this.status.textContent = this.statusText = text;
    const empty = this.key !== "log" && !rollout;
    this.empty.hidden = !empty;
    if (empty) this.empty.textContent = variant?.reason ?? (state.isRunning ? "Simulating …" : "Press S to simulate.");
    this.describe();
  }

  describe() {
    const index = state.hovered, one = index >= 0 && this.states?.[index];
    this.tip.hidden = !one;
    if (one) this.tip.textContent = `${agentName(index)} · ${one.speed.toFixed(1)} m/s`;
  }

  nearest([x, y]) {
    let best = -1, least = Math.max(2.5, 14 / this.scale);
    (this.states || []).forEach((one, i) => {
      const distance = one ? Math.hypot(one.x - x, one.y - y) : Infinity;
      if (distance < least) { least = distance; best = i; }
    });
    return best;
  }
}

function agentName(index) {
  const [id, type, , , role] = state.scene.agents[index];
  return `${TYPE_NAMES[type] || "object"} ${id}${role ? ` · ${ROLE_NAMES[role]}` : ""}`;
}

function traceTrail(path, agent, from) {
  let isDrawing = false;
  for (let i = from; i < agent.valid.length; i++) {
    if (!agent.valid[i]) { isDrawing = false; continue; }
    if (isDrawing) path.lineTo(agent.x[i], agent.y[i]); else path.moveTo(agent.x[i], agent.y[i]);
    isDrawing = true;
  }
}

function halo(ctx, one, [, type, length, width], color, px, strength) {
  const radius = Math.max(length, width) / 200 + (type === PEDESTRIAN || type === CYCLIST ? 6 : 4) * px;
  ctx.beginPath(); ctx.arc(one.x, one.y, Math.max(radius, 9 * px), 0, 2 * Math.PI);
  ctx.fillStyle = ctx.strokeStyle = color; ctx.lineWidth = 2 * px;
  ctx.globalAlpha = 0.08 + 0.35 * strength; ctx.fill(); ctx.globalAlpha = Math.min(1, 0.2 + strength); ctx.stroke(); ctx.globalAlpha = 1;
}

/** Measures frames while playing: a context without a GPU is emulated, which takes seconds a frame; memory of the CPU takes milliseconds. */
class FrameMeter {
  constructor() { this.frames = []; }

  /** True once, when frames turn out to be slow. */
  isSlow(stamp) {
    if (this.isDone) return false;
    this.frames.push(stamp);
    if (this.frames.length <= MEASURED_FRAMES) return false;
    this.isDone = true;
    const gaps = this.frames.slice(1).map((one, i) => one - this.frames[i]).sort((a, b) => a - b);
    return gaps[gaps.length >> 1] > SLOW_FRAME_MS;
  }
}

export { FrameMeter, Ground, MANEUVER_NAMES, NEAR_M, Panel, STEP_S, agentName, maneuverName };
