// The list of scenarios: only the rows in sight exist, thumbnails are drawn when a row stays in sight.
import { get } from "./api.js";
import { buildMap, drawMap } from "./drawing.js";
import { changed, state } from "./state.js";

const ROW_PX = 46, PAGE = 200, KEPT_PICTURES = 300, REST_MS = 180;

class ScenarioList {
  constructor(element, colors, choose) {
    this.element = element; this.colors = colors; this.choose = choose;
    this.space = document.createElement("div");
    this.space.className = "space";
    element.append(this.space);
    this.pages = new Map(); this.pictures = new Map(); this.rows = new Map();
    element.addEventListener("scroll", () => this.render());
    new ResizeObserver(() => this.render()).observe(element);
    element.addEventListener("keydown", (event) => {
      const step = { ArrowDown: 1, ArrowUp: -1, PageDown: 10, PageUp: -10 }[event.key];
      if (step) { this.step(step); event.preventDefault(); event.stopPropagation(); }
    });
  }

  /** Loads the first page for a query; the message of a refusal is thrown. */
  async load(query) {
    const first = await this.fetchPage(query, 0);
    state.query = query; state.total = first.total;
    this.pages = new Map([[0, first.rows]]);
    this.space.style.height = `${first.total * ROW_PX}px`;
    this.element.scrollTop = 0;
    await this.find(state.id);
    this.render();
    changed("list");
  }

  fetchPage(query, page) {
    return get(`api/scenarios?split=${encodeURIComponent(state.split)}&query=${encodeURIComponent(query)}&offset=${page * PAGE}`);
  }

  async row(index) {
    const page = Math.floor(index / PAGE);
    if (!this.pages.has(page)) this.pages.set(page, (await this.fetchPage(state.query, page)).rows);
    return this.pages.get(page)[index - page * PAGE];
  }

  /** Position of a scenario among the loaded rows; -1 where it is not among them. */
  async find(id) {
    state.row = -1;
    for (const [page, rows] of this.pages) {
      const at = rows.findIndex((row) => row.scenario_id === id);
      if (at >= 0) state.row = page * PAGE + at;
    }
  }

  async step(by) {
    if (!state.total) return;
    const index = Math.min(Math.max(state.row + by, 0), state.total - 1), row = await this.row(index);
    state.row = index;
    this.reveal(index);
    this.choose(row.scenario_id);
  }

  reveal(index) {
    const top = index * ROW_PX, { scrollTop, clientHeight } = this.element;
    if (top < scrollTop) this.element.scrollTop = top;
    else if (top + ROW_PX > scrollTop + clientHeight) this.element.scrollTop = top + ROW_PX - clientHeight;
    this.render();
  }

  async render() {
    const first = Math.floor(this.element.scrollTop / ROW_PX), last = Math.min(state.total, first + Math.ceil(this.element.clientHeight / ROW_PX) + 1);
    for (const [index, element] of this.rows) if (index < first || index >= last || element.query !== state.query + state.split) { element.remove(); this.rows.delete(index); }
    const query = state.query;
    for (let index = first; index < last; index++) {
      const row = await this.row(index);
      if (!row || query !== state.query) return;
      this.renderRow(index, row);
    }
    clearTimeout(this.rest);
    this.rest = setTimeout(() => this.drawPictures(), REST_MS);
  }

  renderRow(index, row) {
    let element = this.rows.get(index);
    if (!element) {
      element = document.createElement("div");
      element.className = "row"; element.setAttribute("role", "option"); element.query = state.query + state.split;
      element.id = `row-${index}`;
      element.style.top = `${index * ROW_PX}px`;
      const canvas = document.createElement("canvas"), name = document.createElement("b"), about = document.createElement("span");
      canvas.width = 108; canvas.height = 74;
      name.textContent = row.scenario_id;
      const counts = [["vehicle", "car"], ["pedestrian", "ped"], ["cyclist", "cyc"]].map(([kind, short]) => [row[`num_${kind}s`], short]);
      about.textContent = [row.ego_maneuver.replaceAll("_", " "), ...counts.filter(([count]) => count).map((pair) => pair.join(" ")), ...(row.num_light_states ? ["lights"] : [])].join(" · ");
      element.title = about.textContent;
      element.append(canvas, name, about);
      element.addEventListener("click", () => { state.row = index; this.choose(row.scenario_id); });
      element.scenario = row.scenario_id;
      this.rows.set(index, element);
      this.space.append(element);
      const picture = this.pictures.get(row.scenario_id);
      if (picture) canvas.getContext("2d").drawImage(picture, 0, 0);
    }
    const isChosen = row.scenario_id === state.id;
    element.classList.toggle("chosen", isChosen);
    element.setAttribute("aria-selected", String(isChosen));
    if (isChosen) this.element.setAttribute("aria-activedescendant", element.id);
    element.classList.toggle("has-goals", state.goals.goals.some((goal) => goal.scenario === row.scenario_id));
  }

  /** Thumbnails of the rows in sight, one after the other; a newer call ends an older one. */
  async drawPictures() {
    const turn = (this.turn = (this.turn || 0) + 1);
    for (const element of [...this.rows.values()]) {
      if (turn !== this.turn) return;
      if (this.pictures.has(element.scenario)) continue;
      const { scene } = await get(`api/scenario/${encodeURIComponent(state.split)}/${encodeURIComponent(element.scenario)}`).catch(() => ({}));
      if (!scene) continue;
      const canvas = element.querySelector("canvas"), ctx = canvas.getContext("2d"), [x, y, r] = scene.focus, k = canvas.height / (2 * r);
      ctx.setTransform(k, 0, 0, -k, canvas.width / 2 - k * x, canvas.height / 2 + k * y);
      const colors = this.colors();
      drawMap(ctx, buildMap(scene.map), colors, 1.2 / k);
      this.pictures.set(element.scenario, await createImageBitmap(canvas));
      if (this.pictures.size > KEPT_PICTURES) { const [oldest] = this.pictures.keys(); this.pictures.get(oldest).close(); this.pictures.delete(oldest); }
    }
  }
}

export { ScenarioList };
