// The right side: the selected agent and its goal, outcomes of goals, the score and where it is lost.
import { get } from "./api.js";
import { byId, make, pixelRatio } from "./dom.js";
import { TYPE_NAMES } from "./drawing.js";
import { agentName, maneuverName } from "./stage.js";
import { changed, goalOf, ownGoals, putGoal, removeGoal, state } from "./state.js";

const indexOf = (id) => state.scene.agents.findIndex((agent) => agent[0] === id);
const number = (value, digits = 3) => (value === null || value === undefined ? "–" : value.toFixed(digits).replace("-", "−"));
const goalModels = () => state.session.models.filter((model) => model.takes_goals);

// ---- agent ----------------------------------------------------------------------------------------------------------

function renderAgent(actions) {
  const host = byId("agent");
  const index = state.scene ? indexOf(state.selected) : -1;
  if (index < 0) {
    host.replaceChildren(make("h2", {}, "Agent"), make("p", { class: "muted" }, "Click an agent, or press Tab. Its maneuvers and goal appear here."), ...choiceParts("Or find one that can do", actions));
    return;
  }
  const [id, , length, width] = state.scene.agents[index], goal = goalOf(id), takes = goalModels().length > 0;
  host.replaceChildren(
    make("h2", {}, `Agent ${agentName(index)}`),
    make("dl", {}, make("dt", {}, "speed now"), make("dd", {}, `${number(state.speeds[index], 1)} m/s`), make("dt", {}, "size"), make("dd", {}, `${number(length / 100, 1)} × ${number(width / 100, 1)} m`)),
    ...proposalParts(id, goal, takes, actions),
    ...goalParts(id, goal, takes, actions),
    ...choiceParts("Find an agent that can do", actions),
  );
}

/** Maneuvers that agents of this scenario can do; a press selects the next of them. */
function choiceParts(title, actions) {
  const found = Object.entries(state.maneuvers);
  if (!found.length) return [];
  const buttons = found.map(([name, ids]) => make("li", {}, make("button", { onclick: () => actions.find(ids), title: `Select the next of ${ids.length} agents` }, `${maneuverName(name)} · ${ids.length}`)));
  return [make("p", { class: "note" }, title), make("ul", { class: "choices" }, ...buttons)];
}

function proposalParts(id, goal, takes, actions) {
  const found = state.proposals && state.proposals.agent === id ? state.proposals : null;
  if (!found) return [make("p", { class: "note" }, "Looking for maneuvers …")];
  if (!found.proposals.length) return [make("p", { class: "note" }, `No maneuver to propose: ${found.reason}. Press G and place a goal.`)];
  const buttons = found.proposals.map((proposal, n) => {
    const chosen = goal && goal.x === proposal.x && goal.y === proposal.y;
    const press = () => (chosen ? removeGoal(id) : actions.take(proposal));
    return make("li", {}, make("button", { "aria-pressed": String(Boolean(chosen)), disabled: !takes, onclick: press, title: proposal.doubts.join(" ") || null },
      make("kbd", {}, String(n + 1)), ` ${maneuverName(proposal.maneuver)}${proposal.logged ? " · logged" : ""}`));
  });
  return [make("p", { class: "note" }, "Maneuvers it can do in 8 seconds"), make("ul", { class: "choices" }, ...buttons)];
}

function goalParts(id, goal, takes, actions) {
  if (!takes) return [make("p", { class: "note" }, "No model here takes goals: ", state.session.models[0].note)];
  if (!goal) return [make("p", {}, make("button", { onclick: actions.place }, "place a goal"), make("span", { class: "note" }, "  G, then click, or arrows and Enter"))];
  const doubts = state.doubts.get(id);
  const field = (name) => make("input", {
    type: "number", step: "0.1", value: goal[name].toFixed(2), "aria-label": `goal ${name}, meters, world frame`,
    onchange: (event) => Number.isFinite(event.target.valueAsNumber) && putGoal(id, name === "x" ? event.target.valueAsNumber : goal.x, name === "y" ? event.target.valueAsNumber : goal.y),
  });
  return [
    make("div", { class: "fields" }, make("label", {}, "goal x ", field("x")), make("label", {}, "y ", field("y"))),
    ...(doubts?.refused ? [make("p", { class: "refused", role: "alert" }, doubts.refused)] : []),
    ...(doubts?.doubts ?? []).map((text) => make("p", { class: "doubt" }, text)),
    make("p", {}, make("button", { onclick: () => removeGoal(id) }, "remove"), make("span", { class: "note" }, goal.label ? `  ${goal.label}` : "  drag the pin to move it")),
  ];
}

// ---- outcomes and score ---------------------------------------------------------------------------------------------

function renderResults() {
  const rows = [];
  for (const [key, variant] of state.variants) {
    const found = variant.score;
    for (const outcome of key.endsWith("|free") ? [] : found?.outcomes ?? []) {
      const n = found.num_rollouts;
      rows.push(make("p", { class: "result" }, make("b", {}, `${variant.name}, agent ${outcome.agent}`), `: passed in ${outcome.passed} of ${n}, reached in ${outcome.reached}, `,
        `nearest ${number(outcome.best_m, 1)} m, median ${number(outcome.median_m, 1)} m`));
      if (2 * outcome.passed < n) rows.push(make("p", { class: "note" }, "Few rollouts pass: raise the goal guidance, take an agent that moves, or a nearer goal."));
    }
    if (found?.change) rows.push(make("p", { class: "result" }, `realism ${signed(found.change.mean)} ± ${number(found.change.margin)} against the same seeds without goals (${found.num_rollouts} rollouts)`));
  }
  const host = byId("results");
  host.hidden = !rows.length;
  host.replaceChildren(make("h2", {}, ownGoals().length ? "Goals" : "Goals of the last run"), ...rows);
}

const signed = (value) => `${Number(value.toFixed(3)) < 0 ? "−" : "+"}${Math.abs(value).toFixed(3)}`;

let shownKey = "", axis = "feature";

function renderScore() {
  const host = byId("score"), keys = [...state.variants.keys()].filter((key) => state.panels.includes(key) && state.variants.get(key).score);
  if (!keys.length) {
    const reason = state.scene && !state.hasFuture ? "This split withholds the logged future, which realism is measured against." : "Appears when a simulation is complete.";
    host.replaceChildren(make("h2", {}, "Realism"), make("p", { class: "muted" }, reason));
    return;
  }
  if (!keys.includes(shownKey)) shownKey = keys[0];
  const variant = state.variants.get(shownKey), { score, reason } = variant.score;
  const chooser = keys.length > 1 ? make("select", { "aria-label": "Model", onchange: (event) => { shownKey = event.target.value; renderScore(); } },
    ...keys.map((key) => make("option", { value: key, selected: key === shownKey }, state.variants.get(key).name))) : make("span", { class: "muted" }, variant.name);
  const head = make("h2", {}, "Realism ", chooser);
  if (!score) { host.replaceChildren(head, make("p", { class: "note" }, reason)); return; }
  const { official, ceiling } = score;
  const tabs = ["feature", "agent", "step"].map((name) => make("button", { "aria-pressed": String(axis === name), onclick: () => { axis = name; renderScore(); } }, `by ${name}`));
  host.replaceChildren(
    head,
    make("p", {}, make("span", { class: "big" }, number(official.metametric, 4)), make("span", { class: "muted" }, `  the log: ${number(ceiling.metametric, 4)} · metric ${score.metric}`)),
    make("table", {}, ...["kinematic", "interactive", "map_based"].map((name) => make("tr", {}, make("th", { scope: "row" }, name.replace("_", "-")),
      make("td", {}, number(official.buckets[`${name}_metrics`])), make("td", { class: "muted" }, `log ${number(ceiling.buckets[`${name}_metrics`])}`)))),
    make("div", { class: "tabs", role: "group", "aria-label": "Loss" }, ...tabs),
    lossView(variant, score),
  );
}

function lossView(variant, score) {
  if (axis === "feature") {
    const most = Math.max(...score.features.map((one) => Math.abs(one.lost)), 1e-9);
    const rows = [...score.features].sort((a, b) => b.lost - a.lost).map((one) => make("tr", { title: `likelihood ${number(one.value)}, ceiling ${number(one.ceiling)}, weight ${number(one.weight, 2)}` },
      make("th", { scope: "row" }, one.name.replaceAll("_", " ")), make("td", {}, number(one.value, 2)), make("td", {}, bar(one.lost, most)), make("td", {}, signed(-one.lost))));
    return make("table", { class: "loss" }, make("thead", {}, make("tr", {}, make("th", {}, "feature"), make("th", {}, "value"), make("th", { colspan: "2" }, "lost"))), make("tbody", {}, ...rows));
  }
  const found = variant.explained;
  if (!found) { loadExplanation(variant); return make("p", { class: "muted" }, "Loading …"); }
  if (found.reason) return make("p", { class: "note" }, found.reason);
  return axis === "agent" ? agentTable(found) : stepChart(found);
}

const bar = (value, most) => make("span", { class: `bar${value < 0 ? " negative" : ""}`, width: `${Math.round((60 * Math.abs(value)) / most)}px` });
const sum = (values) => values.reduce((total, value) => total + value, 0);

async function loadExplanation(variant) {
  variant.explained = { reason: "Loading …" };
  try { variant.explained = await get(`api/runs/${variant.run}/explain?variant=${variant.index}`); } catch (error) { variant.explained = { reason: error.message }; }
  renderScore();
}

function agentTable(found) {
  const lost = found.agents.map((_, e) => sum(found.cost.map((byAgent) => sum(byAgent[e])))), most = Math.max(...lost.map(Math.abs), 1e-9);
  const order = lost.map((_, e) => e).sort((a, b) => lost[b] - lost[a]);
  const rows = order.map((e) => make("tr", { class: found.agents[e] === state.selected ? "chosen" : null, onclick: () => { state.selected = found.agents[e]; changed("selection"); } },
    make("th", { scope: "row" }, found.names[e]), make("td", {}, bar(lost[e], most)), make("td", {}, signed(-lost[e]))));
  return make("table", { class: "loss" }, make("tbody", {}, ...rows));
}

/** Bars of the loss over future steps; pointing at a step colors the agents by their loss there. */
function stepChart(found) {
  const steps = found.cost[0][0].length - 1, byStep = Array.from({ length: steps }, (_, t) => sum(found.cost.map((byAgent) => sum(byAgent.map((row) => row[t])))));
  const canvas = make("canvas", { class: "steps", role: "img", "aria-label": "Loss by step" }), whole = sum(found.cost.map((byAgent) => sum(byAgent.map((row) => row[steps]))));
  const draw = (marked = -1) => {
    const ratio = pixelRatio(canvas), width = (canvas.width = canvas.clientWidth * ratio || 560), height = (canvas.height = 46 * ratio), ctx = canvas.getContext("2d");
    const style = getComputedStyle(document.documentElement), most = Math.max(...byStep.map(Math.abs), 1e-9), wide = width / steps;
    byStep.forEach((value, t) => {
      const tall = (Math.abs(value) / most) * height * 0.5;
      ctx.fillStyle = style.getPropertyValue(t === marked ? "--ink" : value < 0 ? "--series-3" : "--series-2");
      ctx.fillRect(t * wide, value < 0 ? height * 0.5 : height * 0.5 - tall, Math.max(1, wide - 1), Math.max(1, tall));
    });
  };
  const stepOf = (event) => Math.min(steps - 1, Math.max(0, Math.floor((event.offsetX / canvas.clientWidth) * steps)));
  canvas.addEventListener("pointermove", (event) => {
    const t = stepOf(event), lost = found.agents.map((_, e) => sum(found.cost.map((byAgent) => byAgent[e][t]))), most = Math.max(...lost, 1e-9);
    state.loss = new Map(found.agents.map((agent, e) => [agent, Math.max(0, lost[e] / most)]));
    draw(t); changed("time");
  });
  canvas.addEventListener("pointerleave", () => { state.loss = null; draw(); changed("time"); });
  canvas.addEventListener("click", (event) => { state.time = state.scene.now + 1 + stepOf(event); changed("time"); });
  requestAnimationFrame(() => draw());
  return make("div", {}, canvas, make("p", { class: "note" }, `Loss above the line, gain below, steps 0.1 to ${steps / 10} s. Collisions, off-road and red lights count for a whole future: ${signed(-whole)}.`));
}

/** Agents as a table: all that the canvas shows at the present step, in words and numbers. */
function agentTableOf(panel) {
  const rows = state.scene.agents.map(([id, type], i) => {
    const one = panel?.states?.[i], goal = goalOf(id);
    return make("tr", {}, make("th", { scope: "row" }, String(id)), make("td", {}, TYPE_NAMES[type] || "object"), make("td", {}, one ? number(one.x + state.origin[0], 1) : "–"), make("td", {}, one ? number(one.y + state.origin[1], 1) : "–"),
      make("td", {}, one ? number(one.speed, 1) : "–"), make("td", {}, goal ? `${number(goal.x, 1)}, ${number(goal.y, 1)}` : ""),
      make("td", {}, make("button", { value: "close", onclick: () => { state.selected = id; changed("selection"); } }, "select")));
  });
  const heads = ["agent", "kind", "x [m]", "y [m]", "m/s", "goal", "choose"].map((text) => make("th", { scope: "col" }, text));
  return make("div", { class: "scroll", tabindex: "0" }, make("table", {}, make("thead", {}, make("tr", {}, ...heads)), make("tbody", {}, ...rows)));
}

/** One sentence about the selected agent, for the live region. */
function sentence() {
  const index = state.scene ? indexOf(state.selected) : -1;
  if (index < 0) return "";
  const agent = state.log.agents[index], now = state.scene.now, goal = goalOf(state.selected), parts = [agentName(index), `${number(state.speeds[index], 1)} m/s`];
  if (goal) {
    const dx = goal.x - state.origin[0] - agent.x[now], dy = goal.y - state.origin[1] - agent.y[now], h = agent.heading[now];
    const ahead = dx * Math.cos(h) + dy * Math.sin(h), left = dy * Math.cos(h) - dx * Math.sin(h);
    parts.push(`goal ${Math.round(Math.hypot(dx, dy))} m ${ahead < 0 ? "behind" : "ahead"}${Math.abs(left) > 3 ? (left > 0 ? " left" : " right") : ""}`);
    for (const variant of state.variants.values()) {
      const outcome = variant.score?.outcomes.find((one) => one.agent === state.selected);
      if (outcome) parts.push(`passed in ${outcome.passed} of ${variant.score.num_rollouts}`);
    }
  }
  return parts.join(", ");
}

export { agentTableOf, goalModels, indexOf, renderAgent, renderResults, renderScore, sentence };
