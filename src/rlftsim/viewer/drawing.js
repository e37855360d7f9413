// Decodes and draws scenes: maps, lights, boxes and paths. A module of the studio; pages that stand alone hold it inline.
const STEP_S = 0.1;
const VEHICLE = 1, PEDESTRIAN = 2, CYCLIST = 3;
const TYPE_NAMES = { 1: "vehicle", 2: "pedestrian", 3: "cyclist" };
const ROLE_NAMES = ["other", "evaluated", "ego"], EGO = 2;
const LIGHT_COLORS = { 1: "stop", 4: "stop", 7: "stop", 2: "caution", 5: "caution", 8: "caution", 3: "go", 6: "go" };
const POLYGONS = ["crosswalk", "speed_bump", "driveway"];

// ---- data -------------------------------------------------------------------------------------------------------

function decodeSeries(second, length) {
  const values = new Float32Array(length);
  let value = 0, slope = 0;
  for (let i = 0; i < length; i++) {
    const d = i < second.length ? second[i] : 0;
    if (i === 0) value = d;
    else { slope = i === 1 ? d : slope + d; value += slope; }
    values[i] = value / 100;
  }
  return values;
}

function decodeFlags(intervals, length) {
  const flags = new Uint8Array(length);
  for (let i = 0; i < intervals.length; i += 2) flags.fill(1, intervals[i], intervals[i + 1]);
  return flags;
}

function decodeAgent([x, y, heading, valid, collides, offroad], steps) {
  return {
    x: decodeSeries(x, steps), y: decodeSeries(y, steps), heading: decodeSeries(heading, steps),
    valid: decodeFlags(valid, steps), collides: decodeFlags(collides, steps), offroad: decodeFlags(offroad, steps),
  };
}

function decodePoints(differences) {
  const points = [];
  let x = 0, y = 0;
  for (let i = 0; i < differences.length; i += 2) {
    x += differences[i]; y += differences[i + 1];
    points.push([x / 100, y / 100]);
  }
  return points;
}

function tracePath(path, points, close) {
  points.forEach(([x, y], i) => (i ? path.lineTo(x, y) : path.moveTo(x, y)));
  if (close) path.closePath();
}

function buildMap(kinds) {
  const map = {};
  for (const [kind, lines] of Object.entries(kinds)) {
    const path = new Path2D();
    for (const line of lines) tracePath(path, decodePoints(line), POLYGONS.includes(kind));
    map[kind] = path;
  }
  map.stop_points = (kinds.stop_sign || []).map((line) => decodePoints(line)[0]);
  return map;
}

function futurePath(agent, from, steps) {
  const path = new Path2D();
  let drawing = false;
  for (let i = from; i < steps; i++) {
    if (!agent.valid[i]) { drawing = false; continue; }
    if (drawing) path.lineTo(agent.x[i], agent.y[i]); else path.moveTo(agent.x[i], agent.y[i]);
    drawing = true;
  }
  return path;
}

// ---- drawing ----------------------------------------------------------------------------------------------------

function readColors(element) {
  const style = getComputedStyle(element);
  return new Proxy({}, { get: (cache, name) => (cache[name] ??= style.getPropertyValue(`--${String(name)}`).trim()) });
}

function drawMap(ctx, map, colors, px) {
  const stroke = (kind, color, width, dash = []) => {
    if (!map[kind]) return;
    ctx.strokeStyle = color; ctx.lineWidth = width; ctx.setLineDash(dash); ctx.stroke(map[kind]);
  };
  const fill = (kind, color) => { if (map[kind]) { ctx.fillStyle = color; ctx.fill(map[kind]); } };
  ctx.lineCap = "round"; ctx.lineJoin = "round";
  fill("driveway", colors.road);
  stroke("lane", colors.road, 4.4);
  stroke("bike_lane", colors.road, 2);
  stroke("lane", colors["lane-center"], px);
  stroke("bike_lane", colors["lane-center"], px);
  for (const kind of ["crosswalk", "speed_bump"]) {
    fill(kind, colors.crosswalk);
    stroke(kind, colors["crosswalk-outline"], px, [0.6, 0.6]);
  }
  ctx.lineCap = "butt";
  stroke("white", colors["line-white"], 1.2 * px);
  stroke("white_broken", colors["line-white"], 1.2 * px, [1.5, 2.5]);
  stroke("yellow", colors["line-yellow"], 1.2 * px);
  stroke("yellow_broken", colors["line-yellow"], 1.2 * px, [1.5, 2.5]);
  stroke("edge", colors.edge, 1.6 * px);
  ctx.setLineDash([]);
  for (const [x, y] of map.stop_points) {
    ctx.beginPath();
    for (let i = 0; i < 8; i++) {
      const a = Math.PI / 8 + (i * Math.PI) / 4;
      ctx.lineTo(x + 6 * px * Math.cos(a), y + 6 * px * Math.sin(a));
    }
    ctx.closePath(); ctx.fillStyle = colors.stop; ctx.fill();
    ctx.fillStyle = colors.surface; ctx.fillRect(x - 3.5 * px, y - 0.9 * px, 7 * px, 1.8 * px);
  }
}

function drawLights(ctx, lights, step, colors, px) {
  for (const [x, y, states] of lights) {
    const name = LIGHT_COLORS[states[Math.min(step, states.length - 1)]];
    ctx.beginPath(); ctx.arc(x / 100, y / 100, 4 * px, 0, 2 * Math.PI);
    ctx.fillStyle = name ? colors[name] : colors.surface;
    ctx.strokeStyle = colors["light-ring"]; ctx.lineWidth = 1.5 * px;
    ctx.fill(); ctx.stroke();
  }
}

function stateAt(agent, time) {
  const step = Math.min(Math.floor(time), agent.x.length - 1), next = Math.min(step + 1, agent.x.length - 1);
  if (!agent.valid[step]) return null;
  const share = agent.valid[next] ? time - step : 0;
  const mix = (values) => values[step] + (values[next] - values[step]) * share;
  const back = agent.valid[step - 1] ? step - 1 : step, ahead = agent.valid[next] ? next : step;
  const distance = Math.hypot(agent.x[ahead] - agent.x[back], agent.y[ahead] - agent.y[back]);
  return {
    x: mix(agent.x), y: mix(agent.y), heading: mix(agent.heading),
    speed: ahead > back ? distance / ((ahead - back) * STEP_S) : 0,
    collides: agent.collides[step], offroad: agent.offroad[step],
  };
}

function traceShape(ctx, type, half, halfWidth) {
  ctx.beginPath();
  if (type === PEDESTRIAN) ctx.arc(0, 0, Math.max(half, halfWidth), 0, 2 * Math.PI);
  else if (type === CYCLIST) ctx.ellipse(0, 0, half, halfWidth, 0, 0, 2 * Math.PI);
  else ctx.roundRect(-half, -halfWidth, 2 * half, 2 * halfWidth, 0.3 * halfWidth);
}

function drawAgent(ctx, state, box, colors, px, hovered) {
  const [, type, length, width, role] = box;
  const small = type === PEDESTRIAN ? 3.2 : type === CYCLIST ? 2.4 : 2;
  const half = Math.max(length / 200, (type === CYCLIST ? 2 : 1) * small * px), halfWidth = Math.max(width / 200, small * px);
  ctx.save();
  ctx.translate(state.x, state.y); ctx.rotate(state.heading);
  const ring = (gap, color, dash) => {
    traceShape(ctx, type, half + gap * px, halfWidth + gap * px);
    ctx.fillStyle = ctx.strokeStyle = color; ctx.lineWidth = 2 * px;
    ctx.globalAlpha = 0.3; ctx.fill(); ctx.globalAlpha = 1;
    ctx.setLineDash(dash); ctx.stroke(); ctx.setLineDash([]);
  };
  if (state.offroad) ring(state.collides ? 8 : 4, colors.offroad, [3 * px, 2 * px]);
  if (state.collides) ring(4, colors.collision, []);
  traceShape(ctx, type, half, halfWidth);
  ctx.fillStyle = colors[`agent-${ROLE_NAMES[role]}`];
  ctx.fill();
  ctx.strokeStyle = hovered ? colors.ink : colors["agent-outline"]; ctx.lineWidth = (hovered ? 2 : 0.8) * px; ctx.stroke();
  // the heading mark: a wedge that points ahead, outside the disc of a pedestrian
  const tip = type === PEDESTRIAN ? half * 1.9 : half * 0.88, root = type === PEDESTRIAN ? half * 0.9 : half * 0.3;
  const spread = type === PEDESTRIAN ? half * 0.7 : halfWidth * 0.66;
  ctx.beginPath(); ctx.moveTo(tip, 0); ctx.lineTo(root, spread); ctx.lineTo(root, -spread); ctx.closePath();
  if (type !== PEDESTRIAN) ctx.fillStyle = colors["heading-mark"];
  ctx.fill();
  ctx.restore();
}

export {
  STEP_S,
  TYPE_NAMES,
  ROLE_NAMES,
  VEHICLE,
  PEDESTRIAN,
  CYCLIST,
  decodeSeries,
  decodeFlags,
  decodeAgent,
  decodePoints,
  tracePath,
  buildMap,
  futurePath,
  readColors,
  drawMap,
  drawLights,
  stateAt,
  traceShape,
  drawAgent,
};
