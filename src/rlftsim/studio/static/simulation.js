// Runs: sends a request, follows its events, and turns chunks into rollouts as they arrive.
import { bytes, follow, get, post } from "./api.js";
import { decodeChunk } from "./decode.js";
import { byId, speak, toast } from "./dom.js";
import { USUAL_SECONDS, changed, ownGoals, state } from "./state.js";

const QUICK_ROLLOUTS = 4, REST_MS = 1000;
let end = () => {}, rest = 0, versions = 0, turns = 0;

const modelOf = (key) => key.split("|")[0];

/** Panels of rollouts from files begin so; names of models have no slash. */
const IMPORTED = "rollouts/";

/** Models of the panels in order, each once. */
const wantedModels = () => [...new Set(state.panels.filter((key) => key !== "log" && !key.startsWith(IMPORTED)).map(modelOf))];

/** Loads the rollouts of files that panels show, and their score. */
async function loadImported() {
  const { id, metric } = state;
  for (const key of state.panels) {
    const known = state.variants.get(key);
    if (!key.startsWith(IMPORTED) || known?.metric === metric) continue;
    const name = key.slice(IMPORTED.length), path = `api/imported/${[name, state.split, id].map(encodeURIComponent).join("/")}`;
    const variant = { name, rollouts: known?.rollouts ?? [], score: null, explained: null, reason: "Loading …", metric, version: ++versions };
    state.variants.set(key, variant);
    try {
      variant.rollouts = decodeChunk(await bytes(path), state.log.agents, state.scene.now);
      if (state.id !== id) return;
      variant.version = ++versions; changed("data");
      const score = await get(`${path}/score?metric=${metric}`);
      if (state.id !== id) return;
      variant.explained = score.explained;
      mark(variant, score);
    } catch (error) { variant.reason = error.message; }
    variant.version = ++versions; changed("data");
  }
}

/** What a click on simulate asks for, as the server takes it. */
function request(count) {
  const goals = ownGoals().filter(({ agent }) => !state.doubts.get(agent)?.refused).map(({ agent, x, y, label }) => ({ agent, x, y, label }));
  const models = wantedModels(), taken = state.seconds === USUAL_SECONDS && models.some((name) => state.session.models.find((model) => model.name === name)?.takes_goals);
  return {
    split: state.split, scenario: state.id, models, goals: taken ? goals : [], num_rollouts: count, seed: state.seed,
    temperature: state.temperature, top_k: state.topK, guidance: state.guidance, metric: state.metric, seconds: state.seconds,
  };
}

async function simulate(count = state.count) {
  clearTimeout(rest);
  if (!wantedModels().length) return toast("No panel shows a model: add one with C, then simulate.");
  end();
  const steps = 10 * state.seconds;
  delete byId("run-status").dataset.over;
  // Whatever arrives after the next press, or after another scenario was opened, is of no use.
  const turn = ++turns, isShown = () => turn === turns;
  let answer;
  try { answer = await post("api/runs", request(count)); } catch (error) { if (isShown()) { toast(error.message); finish(error.message); } return; }
  if (!isShown()) return;
  // Variants that the run holds under the names of the panels; old rollouts stay until the first new ones arrive.
  const hasGoals = answer.variants.some((variant) => variant.goals), names = answer.variants.map((variant) => {
    const model = state.session.models.find((one) => one.name === variant.model), isFree = hasGoals && model.takes_goals && !variant.goals;
    return isFree ? `${variant.model}|free` : variant.model;
  });
  state.run = answer.run; state.runName = names; state.isRunning = true;
  const fresh = new Map(), started = performance.now();
  names.forEach((name, index) => fresh.set(name, { name: name.replace("|free", ", no goals"), run: answer.run, index, rollouts: [], chunks: new Map(), score: null, explained: null, version: 0 }));
  byId("progress").hidden = false; byId("cancel").hidden = false;
  status(`${answer.variants.length > 1 ? `${answer.variants.length} sets of ` : ""}${count} rollouts …`);
  let asked = 0, shown = 0, pending = Promise.resolve();
  /** Jobs in the order of their events, as long as this run is shown. */
  const next = (job) => { pending = pending.then(() => isShown() && job()).catch((error) => { if (error.status !== 404) toast(error.message); }); };

  const load = (data) => {
    const place = ++asked;
    next(async () => {
      if (place < asked && data.steps < steps) return; // a later one has more
      const buffer = await bytes(`api/runs/${answer.run}/chunk/${data.k}`);
      if (!isShown()) return;
      take(fresh, names[data.variant], data, buffer, steps);
      if (!shown++) byId("run-status").dataset.first = String(Math.round(performance.now() - started));
    });
  };

  end = follow(answer.run, (event, data) => {
    if (event === "progress") {
      byId("progress").value = (data.first + (data.count * data.decision) / data.of) / count;
      if (data.first === 0) load(data);
    } else if (event === "chunk") load(data);
    else if (event === "score") next(() => { mark(fresh.get(names[data.variant]), data); publish(fresh, names[data.variant]); });
    else if (event === "done") next(() => finish(`${count} rollouts in ${((performance.now() - started) / 1000).toFixed(1)} s`));
    // A server that was started anew has lost the run: the same request gives the same rollouts.
    else if (event === "failed") next(() => (data.isLost ? simulate(count) : finish(data.message)));
  });
}

/** Puts rollouts of a chunk in their places; a growing chunk is replaced by its later states. */
function take(fresh, name, data, buffer, steps) {
  const variant = fresh.get(name);
  variant.chunks.set(data.first, decodeChunk(buffer, state.log.agents, state.scene.now, state.scene.now + 1 + steps));
  variant.rollouts = [...variant.chunks.entries()].sort(([a], [b]) => a - b).flatMap(([, rollouts]) => rollouts);
  publish(fresh, name);
}

function publish(fresh, name) {
  const variant = fresh.get(name);
  variant.version = ++versions;
  state.variants.set(name, variant);
  // Without goals the two are one and the same.
  if (!fresh.has(`${name}|free`) && !name.endsWith("|free")) state.variants.set(`${name}|free`, variant);
  changed("data");
}

/** The metric's events as flags of the agents, like those of the log. */
function mark(variant, score) {
  variant.score = score;
  const { now, agents } = state.scene, rows = new Map(agents.map(([id], i) => [id, i])), flags = { collision: "collides", offroad: "offroad", light: "light" };
  for (const rollout of variant.rollouts) for (const agent of rollout) for (const name of Object.values(flags)) agent[name].fill(0);
  for (const [kind, n, id, start, stop] of score.events) variant.rollouts[n]?.[rows.get(id)][flags[kind]].fill(1, now + 1 + start, now + 1 + stop);
}

function finish(text) {
  state.isRunning = false;
  byId("progress").hidden = true; byId("cancel").hidden = true;
  status(text); speak(text);
  byId("run-status").dataset.over = state.run;
  changed("data", "run");
  byId("results").scrollIntoView({ block: "nearest" });
}

const status = (text) => { byId("run-status").textContent = text; };

async function cancel() { if (state.run && state.isRunning) await post(`api/runs/${state.run}/cancel`).catch((error) => toast(error.message)); }

/** After an edit: a few rollouts at once, and where "live" is on all of them after a second of rest. */
function simulateSoon() {
  clearTimeout(rest);
  if (!wantedModels().length) return;
  simulate(Math.min(QUICK_ROLLOUTS, state.count));
  if (state.live) rest = setTimeout(() => simulate(), REST_MS);
}

function forget() { end(); turns++; clearTimeout(rest); state.run = null; state.isRunning = false; state.variants = new Map(); state.loss = null; byId("progress").hidden = true; byId("cancel").hidden = true; status(""); delete byId("run-status").dataset.over; }

export { IMPORTED, cancel, forget, loadImported, modelOf, simulate, simulateSoon, wantedModels };
