// The page: scenes, panels, pointer and keys. Everything that is shown is in `state`; parts draw themselves when it changes.
import { Refused, get, post } from "./api.js";
import { byId, make, speak, toast } from "./dom.js";
import { buildMap, decodeAgent, decodePoints, readColors } from "./drawing.js";
import { exportDialog, help, openGoals, saveGoals, share, table } from "./files.js";
import { goalModels, indexOf, renderAgent, renderResults, renderScore, sentence } from "./inspector.js";
import { ScenarioList } from "./list.js";
import { IMPORTED, cancel, forget, loadImported, modelOf, simulate, simulateSoon, wantedModels } from "./simulation.js";
import { FrameMeter, Ground, MANEUVER_NAMES, Panel } from "./stage.js";
import { USUAL_SECONDS, changed, fromHash, goalOf, goalsText, onChange, ownGoals, putGoal, redo, removeGoal, setGoals, state, toHash, undo } from "./state.js";
import { Timeline } from "./timeline.js";

const MAX_PANELS = 4, SNAP_M = 1.5, PIN_HIT_PX = 12, CLICK_PX = 4, ALIVE_MS = 1500, LEAST_R = 6, MOST_R = 500, PLACE_AHEAD_S = 4, REST_MS = 400;

// ---- stage ----------------------------------------------------------------------------------------------------------

class Stage {
  constructor(host) {
    this.host = host; this.panels = []; this.ground = new Ground(); this.onCpu = false; this.meter = new FrameMeter();
    new ResizeObserver(() => { this.arrange(); this.draw(); }).observe(host);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.palette = null; changed("colors"); });
  }

  colors() { return (this.palette ??= readColors(document.documentElement)); }

  viewKey() { const { x, y, r } = state.view; return `${state.id},${x},${y},${r}`; }

  indexOf(id) { return state.scene ? indexOf(id) : -1; }

  toMap({ x, y }) { return [x - state.origin[0], y - state.origin[1]]; }

  /** Panels as the state has them; those that stay keep their canvases. */
  layout() {
    while (this.panels.length > state.panels.length) this.panels.pop().element.remove();
    while (this.panels.length < state.panels.length) {
      const element = make("section", { class: "panel" }, make("div", { class: "panel-head" }), make("div", { class: "frame" }, make("div", { class: "panel-tip", hidden: true }), make("div", { class: "panel-empty", hidden: true })));
      this.host.append(element);
      element.querySelector(".panel-head").append(make("select", { "aria-label": "Panel shows" }), make("span", { class: "panel-status" }), make("button", { "aria-label": "Remove this panel", title: "Remove this panel" }, "×"));
      this.panels.push(new Panel(element, this));
    }
    this.panels.forEach((panel, i) => this.head(panel, i));
    this.arrange();
  }

  /** Side by side while there is room for it, else in two rows. */
  arrange() {
    const count = this.panels.length, { clientWidth: width, clientHeight: height } = this.host;
    const columns = count < 3 ? count : width > 2.4 * height || (count === 3 && width > 1.2 * height) ? count : 2;
    this.host.style.setProperty("--columns", String(Math.max(1, columns)));
    this.panels.forEach((panel) => panel.resize());
  }

  head(panel, i) {
    const [select, , remove] = panel.element.querySelector(".panel-head").children;
    const options = [["log", "log"], ...state.session.models.flatMap(({ name, takes_goals: takes }) => (takes ? [[name, name], [`${name}|free`, `${name}, no goals`]] : [[name, name]])), ...importedKeys().map((key) => [key, `${key.slice(IMPORTED.length)}, files`])];
    select.replaceChildren(...options.map(([value, text]) => make("option", { value, selected: value === state.panels[i] }, text)));
    select.value = state.panels[i];
    select.onchange = () => { state.panels = state.panels.with(i, select.value); changed("panels"); };
    remove.hidden = state.panels.length < 2;
    remove.onclick = () => { state.panels = state.panels.filter((_, k) => k !== i); changed("panels"); };
    panel.canvas.setAttribute("aria-label", `Picture of ${select.selectedOptions[0].text}. Tab chooses agents, G places a goal; the button table shows the same as text.`);
  }

  draw() { const colors = this.colors(); this.panels.forEach((panel) => panel.draw(colors)); }

  /** A frame while playing; slow ones make the canvases anew in the CPU's memory. */
  frame(stamp) {
    this.draw(); timeline.render();
    if (!this.meter.isSlow(stamp)) return;
    this.onCpu = true;
    this.panels.forEach((panel) => panel.makeCanvas());
    this.panels.forEach((panel, i) => this.head(panel, i));
    status("drawing on the CPU");
  }

  bind(panel) {
    const { canvas } = panel, fingers = new Map();
    let start = null, grabbed = null;
    const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY); };
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); start = event;
      grabbed = fingers.size === 1 ? this.pinAt(panel, event) : null;
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId), point = panel.toWorld(event);
      if (!last) { this.hover(panel, point, event); return; }
      const before = fingers.size === 2 ? spread() : 0;
      fingers.set(event.pointerId, event);
      if (before) return this.zoom(before / Math.max(spread(), 1));
      if (Math.hypot(event.clientX - start.clientX, event.clientY - start.clientY) < CLICK_PX && !grabbed?.moved) return;
      if (grabbed?.goal) { grabbed.moved = true; const [x, y] = snapped(point, event.altKey); state.placing = { agent: grabbed.goal.agent, x, y }; changed("view"); return; }
      state.view = { ...state.view, x: state.view.x + (last.clientX - event.clientX) / panel.scale, y: state.view.y + (event.clientY - last.clientY) / panel.scale };
      changed("view");
    });
    canvas.addEventListener("pointerup", (event) => {
      const isClick = start && Math.hypot(event.clientX - start.clientX, event.clientY - start.clientY) < CLICK_PX;
      fingers.delete(event.pointerId);
      if (grabbed?.moved) commitPlacing();
      else if (isClick) this.click(panel, event, grabbed);
      grabbed = null;
    });
    canvas.addEventListener("pointercancel", (event) => { fingers.delete(event.pointerId); grabbed = null; state.placing = null; changed("view"); });
    canvas.addEventListener("pointerleave", () => { if (state.hovered >= 0) { state.hovered = -1; changed("time"); } });
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), panel.toWorld(event)); }, { passive: false });
  }

  hover(panel, point, event) {
    if (state.placing) { [state.placing.x, state.placing.y] = snapped(point, event.altKey); return changed("view"); }
    const index = panel.nearest(point);
    canvasClass(panel.canvas, "over", index >= 0 || this.pinAt(panel, event) !== null);
    if (index !== state.hovered) { state.hovered = index; changed("time"); }
  }

  /** The goal or proposal at a pointer. */
  pinAt(panel, event) {
    if (state.placing || !state.scene) return null;
    const [x, y] = panel.toWorld(event), near = (one) => { const [px, py] = this.toMap(one); return Math.hypot(px - x, py - y) * panel.scale <= PIN_HIT_PX; };
    const goal = ownGoals().find(near);
    if (goal) return { goal };
    const proposal = state.proposals?.agent === state.selected && goalModels().length ? state.proposals.proposals.find(near) : null;
    return proposal ? { proposal } : null;
  }

  click(panel, event, pin) {
    if (state.placing) { [state.placing.x, state.placing.y] = snapped(panel.toWorld(event), event.altKey); return commitPlacing(); }
    if (pin?.goal) return select(pin.goal.agent);
    if (pin?.proposal) return takeProposal(pin.proposal);
    const index = panel.nearest(panel.toWorld(event));
    select(index < 0 ? -1 : state.scene.agents[index][0]);
  }

  zoom(factor, [x, y] = [state.view.x, state.view.y]) {
    const r = Math.min(Math.max(state.view.r * factor, LEAST_R), MOST_R), share = r / state.view.r;
    state.view = { x: x + (state.view.x - x) * share, y: y + (state.view.y - y) * share, r };
    changed("view");
  }

  /** Moves and widens the view so far that points of the map are in sight, with a margin. */
  reveal(points) {
    const { canvas, scale } = this.panels[0], [w, h] = [canvas.clientWidth / 2, canvas.clientHeight / 2];
    if (points.every(([x, y]) => Math.abs(x - state.view.x) * scale < w && Math.abs(y - state.view.y) * scale < h)) return;
    const xs = points.map(([x]) => x), ys = points.map(([, y]) => y), [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const needed = Math.max((right - left) / w, (high - low) / h) * 0.65 * Math.min(w, h);
    state.view = { x: (left + right) / 2, y: (low + high) / 2, r: Math.min(Math.max(state.view.r, needed), MOST_R) };
    changed("view");
  }

  placeOf(id) { const { x, y } = state.log.agents[this.indexOf(id)], { now } = state.scene; return [x[now], y[now]]; }

  fit() { const [x, y, r] = state.scene.focus; state.view = { x, y, r }; changed("view"); }
}

const importedKeys = () => state.session.imported.map(({ name }) => IMPORTED + name);
const canvasClass = (canvas, name, on) => canvas.classList.toggle(name, on);
const status = (text) => { byId("status").textContent = text; };

/** A point on the nearest lane center where there is one within reach. */
function snapped([x, y], isFree) {
  if (isFree || !state.lanes) return [x, y];
  let best = [x, y], least = SNAP_M;
  for (const lane of state.lanes) {
    for (let i = 1; i < lane.length; i++) {
      const [ax, ay] = lane[i - 1], dx = lane[i][0] - ax, dy = lane[i][1] - ay;
      const t = Math.min(Math.max(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1), 0), 1), px = ax + t * dx, py = ay + t * dy, away = Math.hypot(px - x, py - y);
      if (away < least) { least = away; best = [px, py]; }
    }
  }
  return best;
}

// ---- goals ----------------------------------------------------------------------------------------------------------

function startPlacing() {
  const index = stage.indexOf(state.selected);
  if (index < 0) return toast("Select an agent first: click it, or press Tab in the picture.");
  if (!goalModels().length) return toast(state.session.models[0].note);
  const agent = state.log.agents[index], now = state.scene.now, far = Math.max(10, PLACE_AHEAD_S * state.speeds[index]), goal = goalOf(state.selected);
  const [x, y] = goal ? stage.toMap(goal) : [agent.x[now] + far * Math.cos(agent.heading[now]), agent.y[now] + far * Math.sin(agent.heading[now])];
  state.placing = { agent: state.selected, x, y };
  stage.panels[0].canvas.focus({ preventScroll: true });
  stage.panels.forEach((panel) => canvasClass(panel.canvas, "placing", true));
  status("click, or arrows and Enter; Esc cancels");
  changed("view");
}

function endPlacing() { state.placing = null; stage.panels.forEach((panel) => canvasClass(panel.canvas, "placing", false)); status(""); changed("view"); }

function commitPlacing() {
  const { agent, x, y } = state.placing;
  endPlacing();
  putGoal(agent, x + state.origin[0], y + state.origin[1]);
}

/** Checks changed goals, then takes a quick look at what they do; refused ones are left out of it. */
async function lookAtGoals() {
  const id = state.id, looks = state.scene && goalModels().length && state.seconds === USUAL_SECONDS && !state.isQuiet;
  if (looks) delete byId("run-status").dataset.over;
  await checkGoals();
  if (looks && state.id === id) simulateSoon();
}

/** Refusals and doubts in the words of the command line. */
async function checkGoals() {
  const goals = ownGoals(), id = state.id;
  state.doubts = new Map();
  if (goals.length) {
    try {
      const found = await post("api/goals/check", { split: state.split, scenario: id, goals: goals.map(({ agent, x, y, label }) => ({ agent, x, y, label })) });
      if (state.id !== id) return;
      for (const one of found.goals) state.doubts.set(one.agent, one);
    } catch (error) { toast(error.message); }
  }
  renderAgent(actions);
}

function select(id) {
  if (id === state.selected) return;
  state.selected = id;
  changed("selection");
}

const fetchProposals = (agent) => get(`api/proposals/${encodeURIComponent(state.split)}/${encodeURIComponent(state.id)}/${agent}`);

async function loadProposals(id) {
  if (id < 0) return;
  try {
    const found = await fetchProposals(id);
    if (state.selected === id) { state.proposals = found; changed("proposals"); }
  } catch (error) { toast(error.message); }
}

/** Which agents can do what, one agent after the other; those with doubts, such as parked ones, come last. */
async function loadManeuvers() {
  const { id } = state, found = Object.fromEntries(Object.keys(MANEUVER_NAMES).map((name) => [name, []]));
  for (const [agent] of state.scene.agents) {
    const answer = await fetchProposals(agent).catch(() => ({ proposals: [] }));
    if (state.id !== id) return;
    for (const { maneuver, doubts } of answer.proposals) found[maneuver][doubts.length ? "push" : "unshift"](agent);
  }
  state.maneuvers = Object.fromEntries(Object.entries(found).filter(([, agents]) => agents.length));
  renderAgent(actions);
}

/** The next of some agents behind the selected one, in sight. */
function selectNext(ids) {
  const id = ids[(ids.indexOf(state.selected) + 1) % ids.length];
  select(id);
  stage.reveal([stage.placeOf(id)]);
}

const nextAgent = (by) => { const { agents } = state.scene, at = indexOf(state.selected); select(agents[(at + by + agents.length + (at < 0 && by < 0 ? 1 : 0)) % agents.length][0]); };

function chooseManeuver(number) {
  const proposal = state.proposals?.proposals[number - 1];
  if (proposal && goalModels().length) takeProposal(proposal);
}

function takeProposal({ x, y, label }) {
  stage.reveal([stage.placeOf(state.selected), stage.toMap({ x, y })]);
  putGoal(state.selected, x, y, label);
}

// ---- scenes ---------------------------------------------------------------------------------------------------------

async function openScenario(id, { view = null, time = null } = {}) {
  const turn = ++openings;
  let found;
  try { found = await get(`api/scenario/${encodeURIComponent(state.split)}/${encodeURIComponent(id)}`); } catch (error) { toast(error.message); return false; }
  if (turn !== openings) return true; // another one was chosen meanwhile
  forget();
  Object.assign(state, {
    id, scene: found.scene, origin: found.origin, speeds: found.speeds, hasFuture: found.has_future, map: buildMap(found.scene.map),
    lanes: [...(found.scene.map.lane ?? []), ...(found.scene.map.bike_lane ?? [])].map(decodePoints),
    log: { steps: found.log.steps, agents: found.log.rollouts[0].map((agent) => decodeAgent(agent, found.log.steps)) },
    selected: -1, hovered: -1, proposals: null, maneuvers: {}, placing: null, rollout: 0, time: time ?? found.scene.now,
  });
  const [x, y, r] = found.scene.focus;
  state.view = view ?? { x, y, r };
  byId("scenario-name").value = id;
  document.title = `${id} · rlftsim studio`;
  if (found.note) status(found.note);
  changed("scene", "view", "data", "selection");
  clearTimeout(finding);
  if (goalModels().length) finding = setTimeout(loadManeuvers, REST_MS); // not while scenarios are stepped through
  checkGoals();
  return true;
}

/** The scenario before or after; of an open goals file where there is one, passing over scenarios that the data set lacks. */
async function stepScenario(by) {
  const through = state.stepThrough;
  if (!through?.length) return list.step(by);
  const at = through.indexOf(state.id), splits = [state.split, ...state.session.splits.map((one) => one.name)];
  for (let k = 1; k <= through.length; k++) {
    const id = through[(((at + by * k) % through.length) + through.length) % through.length];
    for (const split of splits) {
      const known = await get(`api/scenarios?split=${encodeURIComponent(split)}&query=${encodeURIComponent(`id=${id}`)}`);
      if (!known.total) continue;
      if (split !== state.split) await openSplit(split);
      await openScenario(id);
      await list.find(state.id);
      return;
    }
  }
  toast("None of the file's scenarios is in this data set; its goals stay in it.");
}

async function openSplit(split) {
  state.split = split; byId("split").value = split;
  list.pages.clear(); list.pictures.clear();
  await list.load("");
}

// ---- keys -----------------------------------------------------------------------------------------------------------

const KEYS = {
  " ": () => timeline.toggle(),
  ArrowLeft: (event) => timeline.step(event.shiftKey ? -10 : -1),
  ArrowRight: (event) => timeline.step(event.shiftKey ? 10 : 1),
  Home: () => timeline.step(-Infinity), End: () => timeline.step(Infinity),
  "[": () => stepRollout(-1), "]": () => stepRollout(1),
  a: () => { state.showAll = !state.showAll; changed("data"); },
  t: () => { state.trails = !state.trails; changed("data"); },
  g: startPlacing, s: () => simulate(), c: addPanel, f: () => stage.fit(),
  "+": () => stage.zoom(1 / 1.4), "=": () => stage.zoom(1 / 1.4), "-": () => stage.zoom(1.4),
  n: () => stepScenario(1), p: () => stepScenario(-1),
  Delete: () => removeGoal(state.selected), Backspace: () => removeGoal(state.selected),
  Escape: () => (state.isRunning ? cancel() : select(-1)),
  "?": help,
  ...Object.fromEntries([1, 2, 3, 4, 5, 6].map((n) => [String(n), () => chooseManeuver(n)])),
};

function onKey(event) {
  if (byId("dialog").open) return;
  const { target, key } = event, isText = target.matches("input:not([type='checkbox'], [type='range']), select, textarea");
  if (event.ctrlKey || event.metaKey) {
    const action = { s: saveGoals, z: event.shiftKey ? redo : undo, y: redo }[key.toLowerCase()];
    if (!action || (isText && key.toLowerCase() !== "s")) return;
    event.preventDefault(); action();
    return;
  }
  if (isText || event.altKey) return;
  if (state.placing && movePlacing(event)) return event.preventDefault();
  // Tab leaves the picture behind the last agent, so that nothing is out of a keyboard's reach.
  if (key === "Tab" && target.matches(".panel canvas")) {
    const at = indexOf(state.selected), last = state.scene.agents.length - 1;
    if ((event.shiftKey && at === 0) || (!event.shiftKey && at === last)) return;
    event.preventDefault();
    return nextAgent(event.shiftKey ? -1 : 1);
  }
  if ((key === " " || key === "Enter") && target.matches("button, [role='option'], input")) return;
  if (target.matches("input[type='range']") && key.startsWith("Arrow")) return;
  const action = KEYS[key] ?? KEYS[key.toLowerCase()];
  if (!action) return;
  event.preventDefault(); action(event);
}

/** Arrows move the goal that is being placed; true if the key was for it. */
function movePlacing(event) {
  const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key] ?? [0, 0], far = event.shiftKey ? 5 : 1;
  if (event.key === "Escape") endPlacing();
  else if (event.key === "Enter") commitPlacing();
  else if (dx || dy) { state.placing.x += far * dx; state.placing.y += far * dy; changed("view"); } else return false;
  return true;
}

function stepRollout(by) {
  const count = byId("rollout").length;
  state.rollout = (Math.min(state.rollout, count - 1) + by + count) % count;
  changed("data");
}

/** One more panel: the next model that is not shown, or the first one without goals, or the log. */
function addPanel() {
  if (state.panels.length >= MAX_PANELS) return toast(`${MAX_PANELS} panels are the most: remove one first.`);
  const wanted = [...state.session.models.map((model) => model.name), ...goalModels().map((model) => `${model.name}|free`), ...importedKeys(), "log"];
  state.panels = [...state.panels, wanted.find((key) => !state.panels.includes(key)) ?? wanted[0]];
  changed("panels");
}

// ---- wiring ---------------------------------------------------------------------------------------------------------

const stage = new Stage(byId("panels"));
const timeline = new Timeline((stamp) => stage.frame(stamp));
const list = new ScenarioList(byId("rows"), () => stage.colors(), (id) => openScenario(id));
const actions = { place: startPlacing, find: selectNext, take: takeProposal };
let drawing = 0, addressing = 0, finding = 0, openings = 0;

/** Draws once before the next frame, however many changes there are. */
function drawSoon() {
  if (state.playing || drawing) return;
  drawing = requestAnimationFrame(() => { drawing = 0; stage.draw(); timeline.render(); });
}

onChange((topics) => {
  const has = (...names) => names.some((name) => topics.has(name));
  // Before anything is drawn: the proposals of another agent must not become this one's goals.
  if (has("selection") && state.proposals?.agent !== state.selected) { state.proposals = null; loadProposals(state.selected); }
  if (has("panels")) stage.layout();
  if (has("panels", "settings")) renderNote();
  if (has("settings")) timeline.collect();
  if (has("panels", "scene", "settings") && state.scene) loadImported();
  if (has("data", "panels", "scene")) { timeline.renderRollouts(); timeline.collect(); renderResults(); renderScore(); }
  if (has("goals")) { timeline.collect(); list.render(); lookAtGoals(); }
  if (has("selection", "goals", "proposals", "scene")) renderAgent(actions);
  if (has("selection") && state.scene) { speak(sentence()); renderScore(); }
  if (has("scene")) list.render();
  if (has("run")) speak(sentence());
  if (has("open-first")) stepScenario(1);
  drawSoon();
  clearTimeout(addressing);
  addressing = setTimeout(() => { if (!state.playing && state.scene) history.replaceState(null, "", toHash()); }, 400);
});

function renderNote() {
  const shown = wantedModels().map((name) => state.session.models.find((model) => model.name === name));
  const notes = shown.filter((model) => !model.takes_goals).map((model) => model.note);
  if (state.seconds !== USUAL_SECONDS) notes.push(`Without goals and score, which are defined for ${USUAL_SECONDS} seconds.`);
  byId("model-note").textContent = notes.join(" ");
  byId("guidance").disabled = !shown.some((model) => model.can_guide);
  byId("guidance").title = byId("guidance").disabled ? "No shown model has a goal logit bias that could be scaled." : "";
}

function bindSettings() {
  const bind = (id, name, read) => byId(id).addEventListener("change", (event) => { state[name] = read(event.target); changed("settings"); });
  bind("rollouts", "count", (element) => Number(element.value));
  bind("seconds", "seconds", (element) => { element.value = String(Math.min(Math.max(Math.round(element.valueAsNumber || 0), Number(element.min)), Number(element.max))); return element.valueAsNumber; });
  bind("seed", "seed", (element) => Math.max(0, Math.round(element.valueAsNumber || 0)));
  bind("temperature", "temperature", (element) => (Number.isFinite(element.valueAsNumber) ? element.valueAsNumber : 1));
  bind("top-k", "topK", (element) => (element.valueAsNumber >= 1 ? Math.round(element.valueAsNumber) : null));
  bind("metric", "metric", (element) => element.value);
  bind("live", "live", (element) => element.checked);
  byId("guidance").addEventListener("input", (event) => { state.guidance = Number(event.target.value); byId("guidance-value").value = event.target.value; });
  byId("guidance").addEventListener("change", () => changed("goals"));
  byId("simulate").addEventListener("click", () => simulate());
  byId("cancel").addEventListener("click", cancel);
  byId("previous").addEventListener("click", () => stepScenario(-1));
  byId("next").addEventListener("click", () => stepScenario(1));
  byId("share").addEventListener("click", share);
  byId("save").addEventListener("click", saveGoals);
  byId("open-goals").addEventListener("click", () => byId("goals-file").click());
  byId("goals-file").addEventListener("change", (event) => { const [file] = event.target.files; if (file) openGoals(file); event.target.value = ""; });
  byId("export").addEventListener("click", () => exportDialog(stage.panels));
  byId("table").addEventListener("click", () => table(stage.panels.at(-1)));
  byId("help").addEventListener("click", help);
  byId("split").addEventListener("change", async (event) => { await openSplit(event.target.value); state.row = -1; await list.step(1); });
  let typing = 0;
  byId("query").addEventListener("input", (event) => {
    clearTimeout(typing);
    typing = setTimeout(async () => {
      byId("query-error").textContent = "";
      try { await list.load(event.target.value.trim()); byId("count").textContent = `${state.total}`; } catch (error) { byId("query-error").textContent = error.message; }
    }, 200);
  });
  addEventListener("keydown", onKey);
}

/** Settings of an address in the fields of the page. */
function showSettings() {
  byId("rollouts").value = String(state.count); byId("seconds").value = String(state.seconds); byId("seed").value = String(state.seed); byId("temperature").value = String(state.temperature);
  byId("top-k").value = state.topK ?? ""; byId("metric").value = state.metric; byId("guidance").value = String(state.guidance); byId("guidance-value").value = String(state.guidance);
}

/** Asks now and then whether the server is there; says so when it is gone, and when it is back. */
function watchServer() {
  let isGone = false;
  setInterval(async () => {
    try {
      await get("api/alive");
      if (isGone) toast("The studio is back.");
      isGone = false; byId("status").classList.remove("error");
      if (byId("status").textContent.startsWith("The studio")) status("");
    } catch (error) {
      isGone = true; byId("status").classList.add("error");
      status(error instanceof Refused ? "The studio was started anew: open the address that it printed." : "The studio does not answer: is it still running in the terminal?");
    }
  }, ALIVE_MS);
}

async function start() {
  state.session = await get("api/session");
  const found = fromHash(location.hash), { models, splits } = state.session, names = new Set(["log", ...models.flatMap(({ name }) => [name, `${name}|free`]), ...importedKeys()]);
  for (const name of ["seed", "count", "seconds", "temperature", "topK", "guidance", "metric", "showAll"]) if (name in found) state[name] = found[name];
  state.split = splits.some((one) => one.name === found.split) ? found.split : state.session.split;
  // The first model that takes goals is the one to begin with.
  const first = goalModels()[0] ?? models[0];
  const usual = ["log", first.name, ...importedKeys()].slice(0, MAX_PANELS);
  state.panels = (found.panels ?? usual).filter((key) => names.has(key));
  if (!state.panels.length) state.panels = usual;
  byId("split").replaceChildren(...splits.map((one) => make("option", { value: one.name, selected: one.name === state.split }, `${one.name} (${one.scenarios})`)));
  bindSettings(); showSettings();
  stage.layout(); renderNote();
  const firstRow = get(`api/scenarios?split=${encodeURIComponent(state.split)}`), id = found.id ?? (await firstRow).rows[0].scenario_id;
  if (!(await openScenario(id, { view: found.view, time: found.step }))) await openScenario((await firstRow).rows[0].scenario_id);
  await list.load("");
  byId("count").textContent = `${state.total}`;
  if (found.goals.length) { state.isQuiet = true; setGoals(found.goals.map((goal) => ({ ...goal, scenario: state.id })), { remember: false }); state.isQuiet = false; }
  if (stage.indexOf(found.agent) >= 0) select(found.agent);
  if (found.file) toast(`This address names a goals file: open ${found.file}.json.`);
  // Refused goals are left out of the run, so they have to be known before.
  if (found.run) { state.rollout = found.rollout ?? 0; await checkGoals(); await simulate(); }
  else if (found.step === undefined && !matchMedia("(prefers-reduced-motion: reduce)").matches) timeline.toggle(true);
  watchServer();
}

globalThis.studio = { state, stage, timeline, openScenario, goalsText, modelOf }; // for tests and the console
start().catch((error) => { status(error.message); toast(error.message); });
