// Compares the page with our renderer, policy and physics: browser.html?check, which `make page-check` opens.

const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const largest = (a, b) => a.reduce((most, value, i) => Math.max(most, Math.abs(value - b[i])), 0);
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

/** Differences of one of our images from the page's, [4, size, size] each, over pixels of any channel. */
function compare(ours, theirs) {
  const count = ours.length / 4, colour = [], depth = [];
  let edges = 0;
  for (let pixel = 0; pixel < count; pixel++) {
    const differences = [0, 1, 2, 3].map((k) => Math.abs(ours[k * count + pixel] - theirs[k * count + pixel]));
    if (Math.max(...differences) > 2) edges++; // another shape is nearest there
    colour.push(differences[0], differences[1], differences[2]);
    depth.push(differences[3]);
  }
  return { edges: edges / count, colour: mean(colour), depth: mean(depth) };
}

/** Numbers from 0 to 1 that follow from a seed (mulberry32). */
function random(seed) {
  return () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

/**
 * Measure everything.
 *
 * @param reach `Reach`.
 * @param golden Contents of golden.json.
 * @param goals Number of episodes.
 */
export async function check(reach, golden, goals = 50) {
  const result = { frames: golden.frames.length, goals };
  const images = [], goalImages = [], actions = [], chosen = [], joints = [];
  for (const frame of golden.frames) {
    reach.put(reach.data, { qpos: frame.qpos });
    images.push(compare(bytes(frame.image), reach.look()));
    reach.aim(frame.point);
    joints.push(largest(frame.goal_qpos, reach.goalData.qpos));
    goalImages.push(compare(bytes(frame.goal), reach.goal));
    actions.push(largest(frame.action, await reach.decide(bytes(frame.image), bytes(frame.goal))));
    chosen.push(largest(frame.action, await reach.decide(reach.look(), reach.goal)));
  }
  for (const [name, compared] of Object.entries({ image: images, goal: goalImages })) {
    for (const key of ["edges", "colour", "depth"]) result[`${name}_${key}`] = mean(compared.map((each) => each[key]));
  }
  result.action = Math.max(...actions); // of the policy alone
  result.chosen_median = chosen.sort((a, b) => a - b)[chosen.length >> 1]; // with the page's own images
  result.goal_joints = Math.max(...joints); // rad
  reach.reset();
  const drift = golden.actions.map((action, step) => {
    reach.act(action);
    return Math.hypot(...golden.grips[step].map((value, axis) => value - reach.grip()[axis]));
  });
  result.drift = Math.max(...drift); // m
  const draw = random(59), [low, high] = reach.task.goal_box;
  let reached = 0, milliseconds = 0;
  for (let goal = 0; goal < goals; goal++) {
    reach.reset();
    reach.aim(low.map((value, axis) => value + draw() * (high[axis] - value)));
    for (let step = 0; step < reach.task.horizon; step++) {
      const start = performance.now();
      await reach.step();
      milliseconds += performance.now() - start;
    }
    if (reach.distance() <= reach.task.threshold) reached++;
  }
  result.success = reached / goals;
  result.step_ms = milliseconds / (goals * reach.task.horizon);
  return result;
}
