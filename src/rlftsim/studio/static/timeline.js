// The time line: play, step, and marks where a shown rollout collides, leaves the road, runs a red light, gets to a goal.
import { byId, make, pixelRatio } from "./dom.js";
import { NEAR_M, STEP_S } from "./stage.js";
import { changed, ownGoals, state } from "./state.js";

const HOLD_AT_END_S = 1.0, HIT_PX = 6;
const KINDS = { collision: ["--collision", "✕"], offroad: ["--offroad", "▲"], light: ["--stop", "■"], goal: ["--good", "●"] };

class Timeline {
  constructor(frame) {
    this.frame = frame; this.marks = []; this.held = 0; this.lastStep = 90;
    this.slider = byId("time");
    this.slider.addEventListener("input", () => { this.toggle(false); this.seek(Number(this.slider.value)); });
    byId("play").addEventListener("click", () => this.toggle());
    byId("back").addEventListener("click", () => this.step(-1));
    byId("forward").addEventListener("click", () => this.step(1));
    byId("speed").addEventListener("change", (event) => { state.speed = Number(event.target.value); });
    byId("rollout").addEventListener("change", (event) => { state.rollout = Number(event.target.value); changed("data"); });
    byId("all").addEventListener("change", (event) => { state.showAll = event.target.checked; changed("data"); });
    byId("trails").addEventListener("change", (event) => { state.trails = event.target.checked; changed("data"); });
    const canvas = byId("marks");
    canvas.addEventListener("click", (event) => this.jump((event.offsetX / canvas.clientWidth) * this.lastStep, event.offsetX));
    new ResizeObserver(() => this.drawMarks()).observe(canvas);
  }

  step(by) { this.toggle(false); this.seek(Math.round(state.time) + by); }

  seek(time) { state.time = Math.min(Math.max(time, 0), this.lastStep); changed("time"); }

  toggle(playing = !state.playing) {
    if (playing === state.playing) return;
    state.playing = playing; this.held = 0;
    byId("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    byId("play").classList.toggle("playing", playing);
    if (!playing) return changed("paused");
    if (state.time >= this.lastStep) state.time = 0;
    this.last = performance.now();
    requestAnimationFrame((stamp) => this.tick(stamp));
  }

  tick(stamp) {
    if (!state.playing) return;
    const elapsed = Math.min(Math.max((stamp - this.last) / 1000, 0), 0.25);
    this.last = stamp;
    if (state.time < this.lastStep) state.time = Math.min(this.lastStep, state.time + (elapsed * state.speed) / STEP_S);
    else if ((this.held += elapsed) > HOLD_AT_END_S) { this.held = 0; state.time = 0; }
    this.frame(stamp);
    requestAnimationFrame((next) => this.tick(next));
  }

  render() {
    const seconds = (state.time - (state.scene?.now ?? 10)) * STEP_S;
    this.slider.value = String(state.time);
    const rounded = Math.round(10 * seconds) / 10;
    byId("clock").textContent = `${rounded < 0 ? "−" : "+"}${Math.abs(rounded).toFixed(1)} s ${rounded < 0 ? "history" : rounded ? "future" : "now"}`;
    this.slider.setAttribute("aria-valuetext", byId("clock").textContent);
  }

  renderRollouts() {
    const count = Math.max(1, ...state.panels.map((key) => state.variants.get(key)?.rollouts.length ?? 0)), chooser = byId("rollout");
    document.querySelectorAll(".several").forEach((element) => element.toggleAttribute("hidden", count < 2));
    if (chooser.length !== count) chooser.replaceChildren(...Array.from({ length: count }, (_, n) => make("option", { value: n }, `${n + 1} of ${count}`)));
    chooser.value = String(Math.min(state.rollout, count - 1));
    byId("all").checked = state.showAll; byId("trails").checked = state.trails;
  }

  /** The last step of what is shown or asked for. */
  renderLength() {
    const now = state.scene?.now ?? 10, lengths = state.panels.map((key) => state.variants.get(key)?.rollouts[0]?.[0]?.valid.length ?? 0);
    this.lastStep = Math.max(now + 10 * state.seconds, ...lengths.map((length) => length - 1));
    this.slider.max = String(this.lastStep);
    state.time = Math.min(state.time, this.lastStep);
  }

  /** Collects events of the shown variants: kind, rollout and step; goals from the poses themselves. */
  collect() {
    this.marks = [];
    this.renderLength();
    if (!state.scene) return;
    const { now, agents } = state.scene;
    for (const key of state.panels) {
      const variant = state.variants.get(key);
      if (!variant) continue;
      for (const [kind, rollout, agent, start] of variant.score?.events ?? []) this.marks.push({ kind, rollout, agent, step: now + 1 + start });
      if (key.endsWith("|free")) continue;
      for (const goal of ownGoals()) {
        const a = agents.findIndex(([id]) => id === goal.agent);
        if (a < 0) continue; // a file or an address may name agents that are not there
        const x = goal.x - state.origin[0], y = goal.y - state.origin[1];
        variant.rollouts.forEach((rollout, n) => {
          for (let i = now + 1; i < this.lastStep + 1 && rollout[a].valid[i]; i++) {
            if (Math.hypot(rollout[a].x[i] - x, rollout[a].y[i] - y) <= NEAR_M) { this.marks.push({ kind: "goal", rollout: n, agent: goal.agent, step: i }); break; }
          }
        });
      }
    }
    this.drawMarks();
  }

  drawMarks() {
    const canvas = byId("marks"), ratio = pixelRatio(canvas), ctx = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    canvas.width = canvas.clientWidth * ratio; canvas.height = 14 * ratio;
    ctx.scale(ratio, ratio);
    const rule = style.getPropertyValue("--rule"), muted = style.getPropertyValue("--muted");
    for (let step = 0; step <= this.lastStep; step += 10) { ctx.fillStyle = step === 10 ? muted : rule; ctx.fillRect((step / this.lastStep) * (canvas.clientWidth - 1), 0, 1, step === 10 ? 14 : 5); }
    ctx.font = "9px system-ui, sans-serif"; ctx.textAlign = "center"; ctx.textBaseline = "middle";
    for (const [kind, [color, sign]] of Object.entries(KINDS)) {
      ctx.fillStyle = style.getPropertyValue(color);
      for (const mark of this.marks) {
        if (mark.kind !== kind) continue;
        ctx.globalAlpha = mark.rollout === state.rollout ? 1 : 0.35;
        ctx.fillText(sign, (mark.step / this.lastStep) * canvas.clientWidth, 8);
      }
    }
    canvas.setAttribute("aria-label", `${this.marks.length} events of the shown rollouts`);
  }

  /** Goes to the mark nearest to a click and shows its rollout; to the time itself where there is no mark. */
  jump(step, x) {
    const width = byId("marks").clientWidth, away = (mark) => Math.abs((mark.step / this.lastStep) * width - x);
    const near = this.marks.filter((mark) => away(mark) < HIT_PX).sort((a, b) => away(a) - away(b))[0];
    this.toggle(false);
    if (near) { state.rollout = near.rollout; state.selected = near.agent; state.time = near.step; changed("data", "selection", "time"); } else this.seek(Math.round(step));
  }
}

export { Timeline };
