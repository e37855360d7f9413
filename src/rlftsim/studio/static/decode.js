// Rollouts from bytes, in the layout of the server's encoding.py.
const MAGIC = 0x31464c52, HEADER_BYTES = 20;

/**
 * Rollouts of a chunk, each a list of agents like those of `decodeAgent`; history comes from the log.
 * @param {ArrayBuffer} buffer
 * @param {Array} log agents of the logged motion
 * @param {number} now current step
 * @param {number} [total] steps, history included; more than there are yet where a rollout grows
 */
function decodeChunk(buffer, log, now, total = 0) {
  const [magic, count, agents, steps, bytes] = new Uint32Array(buffer, 0, 5);
  if (magic !== MAGIC) throw new Error("these are no rollouts of this version: reload the page.");
  total = Math.max(total, now + 1 + steps);
  const values = bytes === 2 ? new Int16Array(buffer, HEADER_BYTES) : new Int32Array(buffer, HEADER_BYTES);
  const rollouts = [];
  let at = 0;
  for (let n = 0; n < count; n++) {
    const motion = [];
    for (let a = 0; a < agents; a++) {
      const agent = { valid: new Uint8Array(total), collides: new Uint8Array(total), offroad: new Uint8Array(total), light: new Uint8Array(total) };
      agent.valid.set(log[a].valid.subarray(0, now + 1));
      agent.valid.fill(1, now + 1, now + 1 + steps);
      for (const name of ["x", "y", "heading"]) {
        const series = new Float32Array(total);
        series.set(log[a][name].subarray(0, now + 1));
        let value = Math.round(100 * log[a][name][now]), slope = 0;
        for (let i = 0; i < steps; i++) { slope += values[at++]; value += slope; series[now + 1 + i] = value / 100; }
        agent[name] = series;
      }
      motion.push(agent);
    }
    rollouts.push(motion);
  }
  return rollouts;
}

export { decodeChunk };
