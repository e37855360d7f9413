// Requests to the studio's server. Addresses are relative, so that a proxy's prefix is kept.
const QUIET_MS = 3000, POLL_MS = 500;

class Refused extends Error {
  constructor(status, { error, hint }) { super(error + (hint ? ` ${hint}` : "")); this.status = status; }
}

async function answer(path, options) {
  const response = await fetch(path, options);
  if (response.ok) return response;
  throw new Refused(response.status, await response.json().catch(() => ({ error: `${response.status} ${response.statusText}` })));
}

const get = async (path) => (await answer(path)).json();
const bytes = async (path) => (await answer(path)).arrayBuffer();
const post = async (path, body = {}) =>
  (await answer(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) })).json();

/**
 * Calls `handle(event, data)` for every event of a run, in order, each once. Where a proxy holds the stream back, polls.
 * @returns {() => void} ends it
 */
function follow(run, handle) {
  let last = -1, isOver = false, timer = 0;
  const take = (id, event, data) => {
    if (isOver || id <= last) return;
    last = id;
    isOver = event === "done" || event === "failed";
    handle(event, data);
    if (isOver) stop();
  };
  const source = new EventSource(`api/runs/${run}/events`);
  for (const name of ["progress", "chunk", "score", "done", "failed"]) {
    source.addEventListener(name, (event) => { clearTimeout(timer); timer = setTimeout(poll, QUIET_MS); take(Number(event.lastEventId), name, JSON.parse(event.data)); });
  }
  async function poll() {
    if (isOver) return;
    try {
      const state = await get(`api/runs/${run}?after=${last}`);
      for (const { id, event, data } of state.events) take(id, event, data);
    } catch (error) {
      if (error instanceof Refused) take(Infinity, "failed", { message: error.message, isLost: error.status === 404 });
    }
    if (!isOver) timer = setTimeout(poll, POLL_MS);
  }
  timer = setTimeout(poll, QUIET_MS);
  function stop() { isOver = true; clearTimeout(timer); source.close(); }
  return stop;
}

export { Refused, get, bytes, post, follow };
