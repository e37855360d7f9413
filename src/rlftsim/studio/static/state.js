// What the page shows, as one object; goals with undo; the part of it that stands behind # in the address.
const UNDO_STEPS = 50, LONGEST_URL = 2000, USUAL_SECONDS = 8;
/** Numbers of an address: least, most, and whether they are whole. */
const NUMBERS = {
  seed: [0, Number.MAX_SAFE_INTEGER, true], count: [1, 128, true], temperature: [0, 10, false], topK: [1, Number.MAX_SAFE_INTEGER, true],
  guidance: [0, 6, false], seconds: [USUAL_SECONDS, 60, true], step: [0, 610, true], rollout: [0, 127, true], agent: [-Infinity, Infinity, true],
};

const state = {
  session: null, split: "", id: "", row: -1, total: 0, query: "",
  scene: null, log: null, map: null, origin: [0, 0], speeds: [], hasFuture: true,
  panels: [], // "log", a model's name, or a model's name and "|free"
  variants: new Map(), // the same names -> { rollouts, score, explained, name }
  run: null, runName: "", selected: -1, hovered: -1,
  time: 0, rollout: 0, speed: 1, playing: false, showAll: true, trails: true,
  view: { x: 0, y: 0, r: 50 },
  seed: 0, count: 32, seconds: USUAL_SECONDS, temperature: 1, topK: null, guidance: 1, metric: "2025", live: false,
  proposals: null, maneuvers: {}, doubts: new Map(), placing: null, loss: null,
  goals: { goals: [], alternatives: [] }, savedAs: "goals",
};

const listeners = [];
const onChange = (listener) => listeners.push(listener);
/** Tells every part of the page that something changed: "scene", "panels", "goals", "selection", "data", "time", "view" or "settings". */
const changed = (...topics) => listeners.forEach((listener) => listener(new Set(topics)));

// ---- goals ----------------------------------------------------------------------------------------------------------

const undone = [], redone = [];
const ownGoals = () => state.goals.goals.filter((goal) => goal.scenario === state.id);
const goalOf = (agent) => state.goals.goals.find((goal) => goal.scenario === state.id && goal.agent === agent);

function setGoals(goals, { remember = true } = {}) {
  if (remember) { undone.push(state.goals.goals); undone.splice(0, undone.length - UNDO_STEPS); redone.length = 0; }
  state.goals = { ...state.goals, goals };
  changed("goals");
}

function putGoal(agent, x, y, label = "", options = {}) {
  const round = (value) => Math.round(1000 * value) / 1000; // as goals files store it
  const goal = { scenario: state.id, agent, x: round(x), y: round(y), label };
  setGoals([...state.goals.goals.filter((other) => other.scenario !== state.id || other.agent !== agent), goal], options);
}

const removeGoal = (agent) => goalOf(agent) && setGoals(state.goals.goals.filter((goal) => goal.scenario !== state.id || goal.agent !== agent));

function undo() { if (undone.length) { redone.push(state.goals.goals); setGoals(undone.pop(), { remember: false }); } }
function redo() { if (redone.length) { undone.push(state.goals.goals); setGoals(redone.pop(), { remember: false }); } }

/** Text of a goals file; scenarios that are not shown stay in it. */
const goalsText = () => JSON.stringify({ format: "rlftsim-goals-1", goals: state.goals.goals.map(plain), alternatives: state.goals.alternatives.map(plain) });
const plain = ({ scenario, agent, x, y, label }) => ({ scenario, agent, x, y, ...(label ? { label } : {}) });

// ---- address --------------------------------------------------------------------------------------------------------

function toHash() {
  const parts = new URLSearchParams({ split: state.split, id: state.id, panels: state.panels.join(","), step: String(Math.round(state.time)) });
  const { x, y, r } = state.view;
  parts.set("view", [x, y, r].map((v) => v.toFixed(1)).join(","));
  if (state.selected >= 0) parts.set("agent", String(state.selected));
  if (state.rollout) parts.set("rollout", String(state.rollout));
  for (const [name, usual] of Object.entries({ seed: 0, count: 32, seconds: USUAL_SECONDS, temperature: 1, topK: null, guidance: 1, metric: "2025" })) {
    if (state[name] !== usual) parts.set(name, String(state[name]));
  }
  if (!state.showAll) parts.set("all", "0");
  if (state.run) parts.set("run", "1");
  const goals = ownGoals().map((goal) => [`${goal.agent}@${goal.x}`, goal.y, ...(goal.label ? [goal.label.replace(/[;,]/g, " ")] : [])].join(",")).join(";");
  if (goals) parts.set("goals", goals);
  // A link that is too long for mail programs names the file instead.
  if (parts.toString().length > LONGEST_URL) { parts.delete("goals"); parts.set("file", state.savedAs); }
  return `#${parts.toString().replaceAll("%2C", ",").replaceAll("%40", "@").replaceAll("%3B", ";")}`;
}

function fromHash(hash) {
  const parts = new URLSearchParams(hash.slice(1)), found = {};
  for (const name of ["split", "id", "metric", "file"]) if (parts.get(name)) found[name] = parts.get(name);
  for (const [name, [least, most, isWhole]] of Object.entries(NUMBERS)) {
    const value = Number(parts.get(name));
    if (parts.has(name) && Number.isFinite(value)) found[name] = Math.min(Math.max(isWhole ? Math.round(value) : value, least), most);
  }
  if (parts.get("panels")) found.panels = parts.get("panels").split(",").slice(0, 4);
  if (parts.get("all") === "0") found.showAll = false;
  found.run = parts.get("run") === "1";
  const view = (parts.get("view") || "").split(",").map(Number);
  if (view.length === 3 && view.every(Number.isFinite) && view[2] > 0) found.view = { x: view[0], y: view[1], r: view[2] };
  found.goals = [...(parts.get("goals") || "").matchAll(/(-?\d+)@(-?[\d.e+-]+),(-?[\d.e+-]+),?([^;]*)/g)]
    .map(([, agent, x, y, label]) => ({ agent: Number(agent), x: Number(x), y: Number(y), label }))
    .filter(({ x, y }) => Number.isFinite(x) && Number.isFinite(y));
  return found;
}

export { USUAL_SECONDS, state, onChange, changed, ownGoals, goalOf, setGoals, putGoal, removeGoal, undo, redo, goalsText, toHash, fromHash };
