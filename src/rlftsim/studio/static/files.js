// Everything that leaves the page: links, goals files, exports, the command line; and the help.
import { post } from "./api.js";
import { byId, closeDialog, make, openDialog, toast } from "./dom.js";
import { agentTableOf } from "./inspector.js";
import { wantedModels } from "./simulation.js";
import { USUAL_SECONDS, changed, goalsText, ownGoals, setGoals, state, toHash } from "./state.js";

const KEYS = [
  ["Space", "play or pause"], ["← →", "one step, with Shift one second"], ["Home End", "first and last step"], ["[ ]", "rollout before, next"], ["A", "all rollouts or one"],
  ["T", "trails"], ["Tab", "next agent, with Shift the one before (in the picture)"], ["1 … 6", "choose a maneuver"], ["G", "place a goal: click, or arrows and Enter; Esc cancels"],
  ["Del", "remove the goal"], ["S", "simulate; Esc cancels"], ["C", "compare: one more panel"], ["F", "fit"], ["+ −", "zoom"], ["N P", "next, previous scenario; of a goals file, if one is open"],
  ["Ctrl S", "save goals"], ["Ctrl Z, Ctrl Y", "undo, redo"], ["?", "this"],
];

function help() {
  openDialog("Keys", make("div", { class: "scroll" }, make("dl", { class: "keys" }, ...KEYS.flatMap(([key, text]) => [make("dt", {}, make("kbd", {}, key)), make("dd", {}, text)]))),
    make("p", { class: "note" }, "Drag to move, wheel to zoom. Click an agent, then a pin, or drag its goal; Alt keeps the goal off the lanes. A filter joins words: ego_turn=left n_ped>3 lights>0."),
    make("p", { class: "note" }, state.session.license));
}

async function copy(text, message) {
  try { await navigator.clipboard.writeText(text); toast(message); } catch { openDialog("Copy", make("pre", { tabindex: "0" }, text)); }
}

const share = () => { history.replaceState(null, "", toHash()); copy(location.href, "Address copied: it opens this picture on this machine, while this studio runs."); };

/** A file's name: letters, digits, dots, hyphens. */
const stem = (text) => text.replace(/[^A-Za-z0-9._-]+/g, "-").slice(0, 80) || "studio";

/** A form in the dialog for a name; `write` gets name and replace, and its answer's path is shown. */
function askName(title, name, write, ...more) {
  const field = make("input", { id: "file-name", value: stem(name), maxlength: "80", pattern: "[A-Za-z0-9._\\-]{1,80}", required: true, "aria-describedby": "file-error" });
  const replace = make("input", { type: "checkbox" }), error = make("p", { class: "error", id: "file-error", role: "alert" }), done = make("p", { class: "note", role: "status" });
  const press = async (event) => {
    event.preventDefault(); error.textContent = ""; done.textContent = "Writing …";
    try { done.textContent = `${(await write(field.value, replace.checked)).path} written.`; } catch (problem) { done.textContent = ""; error.textContent = problem.message; }
  };
  openDialog(title, make("p", {}, make("label", {}, "name ", field), " ", make("button", { class: "primary", id: "write", onclick: press }, "write")),
    make("p", {}, make("label", { class: "check" }, replace, "replace an existing file")), make("p", { class: "note" }, `Files go to ${state.session.out}.`), error, done, ...more);
  field.focus(); field.select();
}

function saveGoals() {
  if (!state.goals.goals.length) return toast("There are no goals to save: select an agent, then choose a maneuver or press G.");
  const count = state.goals.goals.length, scenarios = new Set(state.goals.goals.map((goal) => goal.scenario)).size;
  askName(`Save ${count} goal${count > 1 ? "s" : ""} of ${scenarios} scenario${scenarios > 1 ? "s" : ""}`, state.savedAs, async (name, replace) => {
    const answer = await post("api/goals/save", { name, text: goalsText(), replace });
    state.savedAs = name;
    return answer;
  });
}

async function openGoals(file) {
  try {
    const found = await post("api/goals/open", { text: await file.text(), name: file.name.slice(0, 200) });
    state.goals = { ...state.goals, alternatives: found.alternatives };
    setGoals(found.goals);
    state.savedAs = stem(file.name.replace(/\.json$/, ""));
    toast(`${found.goals.length} goals of ${new Set(found.goals.map((goal) => goal.scenario)).size} scenarios: N and P step through them.`);
    state.stepThrough = [...new Set(found.goals.map((goal) => goal.scenario))];
    if (state.stepThrough.length && !state.stepThrough.includes(state.id)) changed("open-first");
  } catch (error) { toast(error.message); }
}

const quoted = (text) => (/^[\w./:=@,+-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

/** The command line that gives the same rollouts, one line for each model. */
function commands() {
  return wantedModels().map((name) => {
    const model = state.session.models.find((one) => one.name === name), goals = model.takes_goals && state.seconds === USUAL_SECONDS ? ownGoals() : [];
    const words = ["rlftsim", "simulate", model.source, "--data", state.session.data, "--split", state.split, "--scenario", state.id, "--out", `${stem(`${name}-${state.id}`)}`,
      "--num-rollouts", String(state.count), "--seed", String(state.seed)];
    if (state.temperature !== 1) words.push("--temperature", String(state.temperature));
    if (state.topK) words.push("--top-k", String(state.topK));
    if (state.seconds !== USUAL_SECONDS) words.push("--seconds", String(state.seconds));
    for (const goal of goals) words.push("--goal", `${goal.agent}=${goal.x},${goal.y}`);
    if (goals.length && model.can_guide && state.guidance !== 1) words.push("--guidance-scale", String(state.guidance));
    return words.map(quoted).join(" ");
  });
}

function exportDialog(panel) {
  const keys = [...state.variants.entries()].filter(([key, one]) => one.run && state.panels.includes(key)), done = Boolean(state.run) && !state.isRunning && keys.length > 0;
  const variant = make("select", { "aria-label": "rollouts of" }, ...keys.map(([key, one]) => make("option", { value: key }, one.name)));
  const kinds = [["film-mp4", "film, mp4"], ["film-webp", "film, webp"], ["page", "page that plays by itself"], ["rollouts", "rollouts, npz"], ["submission", "rollouts, official ScenarioRollouts"], ["scores", "scores, JSON"]];
  const kind = make("select", { id: "export-kind", "aria-label": "kind" }, ...kinds.map(([value, text]) => make("option", { value }, text)));
  const write = (name, replace) => {
    const one = state.variants.get(variant.value);
    // The one that the panel shows: it may have fewer rollouts than another one had.
    return post("api/export", { kind: kind.value, name, run: one.run, variant: one.index, rollout: Math.min(state.rollout, one.rollouts.length - 1), replace });
  };
  const lines = commands();
  const parts = [
    make("p", {}, make("button", { onclick: (event) => { event.preventDefault(); picture(panel); } }, "picture of the view, png")),
    lines.length ? make("div", {}, make("b", {}, "As a command"), make("pre", { tabindex: "0" }, lines.join("\n")), make("button", { onclick: (event) => { event.preventDefault(); copy(lines.join("\n"), "Command copied."); closeDialog(); } }, "copy as command")) : null,
  ];
  if (!done) return openDialog("Export", make("p", { class: "muted" }, "Simulate first, then rollouts, films and scores can be written."), ...parts);
  askName("Export", `${state.id}`, write, make("p", {}, make("label", {}, "as ", kind), " ", make("label", {}, "of ", variant)), ...parts);
}

/** Saves the panels as they are on the screen. */
function picture(panels) {
  const width = panels.reduce((total, panel) => total + panel.canvas.width, 0), height = Math.max(...panels.map((panel) => panel.canvas.height)), canvas = make("canvas");
  canvas.width = width; canvas.height = height;
  let x = 0;
  for (const panel of panels) { canvas.getContext("2d").drawImage(panel.canvas, x, 0); x += panel.canvas.width; }
  canvas.toBlob((blob) => {
    const address = URL.createObjectURL(blob), link = make("a", { href: address, download: `${stem(state.id)}.png` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(address), 1000);
  });
}

const table = (panel) => openDialog(`Agents at ${byId("clock").textContent}`, agentTableOf(panel));

export { exportDialog, help, openGoals, saveGoals, share, table };
