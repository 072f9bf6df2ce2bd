// VisualFetchReach in the browser: physics by MuJoCo's WebAssembly, images by renderer.js, actions by an ONNX policy.

import { Renderer, minus } from "./renderer.js";

const IK_STEPS = 10, SETTLING = 3; // as in jaxrl_vis_envs/physics/inverse_kinematics.py

/** The robot, its goal, and what it sees. */
export class Reach {
  /**
   * @param mujoco Module of @mujoco/mujoco.
   * @param session onnxruntime's session of the policy.
   * @param Tensor onnxruntime's class.
   * @param task Contents of task.json.
   */
  constructor(mujoco, session, Tensor, task) {
    Object.assign(this, { mujoco, session, Tensor, task });
    this.model = mujoco.MjModel.from_xml_string(task.xml);
    this.model.opt.iterations = task.iterations;
    this.model.opt.timestep = task.timestep;
    this.data = new mujoco.MjData(this.model);
    this.goalData = new mujoco.MjData(this.model);
    this.renderer = new Renderer(task.scene);
    this.reset();
    this.aim(this.grip());
  }

  /** Put the robot at its start. */
  reset() {
    this.put(this.data, this.task.start);
  }

  /** Put a robot into a state: qpos, and qvel, mocap_pos and mocap_quat where given. */
  put(data, state) {
    this.mujoco.mj_resetData(this.model, data);
    for (const [name, values] of Object.entries(state)) data[name].set(values);
    this.mujoco.mj_forward(this.model, data);
    if (state.qacc_warmstart) data.qacc_warmstart.set(state.qacc_warmstart);
  }

  /** Position of the grip, m. */
  grip(data = this.data) {
    return Array.from(data.site_xpos.subarray(3 * this.task.grip, 3 * this.task.grip + 3));
  }

  /** Distance of the grip from its goal, m. */
  distance() {
    return Math.hypot(...minus(this.grip(), this.grip(this.goalData)));
  }

  /** Show the robot a goal at a point [3], m in the world, within the box of goals: where the arm can be, at rest. */
  aim(point) {
    const { task, goalData: data } = this, [low, high] = task.goal_box;
    const clipped = point.map((value, axis) => Math.min(Math.max(value, low[axis]), high[axis]));
    const target = minus(clipped, task.grip_offset);
    target[2] = Math.max(target[2], task.lowest);
    this.put(data, { qpos: this.closed(task.start.qpos) });
    const first = this.body(data);
    for (let step = 1; step <= IK_STEPS; step++) {
      const share = Math.min(step / (IK_STEPS - SETTLING), 1);
      this.approach(data, target.map((value, axis) => first[axis] + share * (value - first[axis])));
      this.mujoco.mj_kinematics(this.model, data);
    }
    this.goal = this.look(data);
  }

  closed(qpos) {
    return qpos.map((value, joint) => (this.task.fingers.includes(joint) ? 0 : value));
  }

  body(data) {
    return Array.from(data.xpos.subarray(3 * this.task.hand, 3 * this.task.hand + 3));
  }

  /** One step of damped least squares of the hand towards a point [3]. */
  approach(data, target) {
    const { task } = this, position = this.body(data), chain = task.chain;
    const jacobian = chain.map((joint) => {
      const axis = data.xaxis.subarray(3 * joint, 3 * joint + 3);
      return [...cross(axis, minus(position, data.xanchor.subarray(3 * joint, 3 * joint + 3))), ...axis];
    });
    const turn = [0, 0, 0];
    for (let k = 0; k < 3; k++) {
      const own = [0, 1, 2].map((i) => data.xmat[9 * task.hand + 3 * i + k]);
      cross(own, task.rotation.map((row) => row[k])).forEach((value, i) => (turn[i] += 0.5 * value));
    }
    const error = [...minus(target, position), ...turn];
    const solve = (error, mobility) => {
      const matrix = error.map((_, i) =>
        error.map((_, j) => jacobian.reduce((sum, row, n) => sum + mobility[n] * row[i] * row[j], i === j ? task.damping[i] : 0)),
      );
      const force = solveLinear(matrix, error);
      return jacobian.map((row, n) => mobility[n] * row.reduce((sum, value, i) => sum + value * force[i], 0));
    };
    const low = chain.map((joint) => task.ranges[joint][0] - data.qpos[joint]);
    const high = chain.map((joint) => task.ranges[joint][1] - data.qpos[joint]);
    const clip = (value, n) => Math.min(Math.max(value, low[n]), high[n]);
    const mobility = chain.map((joint) => task.mobility[joint]), change = solve(error, mobility);
    const stops = change.map((value, n) => value < low[n] || value > high[n]);
    const stopped = change.map((value, n) => (stops[n] ? clip(value, n) : 0));
    const left = error.map((value, i) => value - stopped.reduce((sum, moved, n) => sum + moved * jacobian[n][i], 0));
    const rest = solve(left, mobility.map((value, n) => (stops[n] ? 0 : value)));
    chain.forEach((joint, n) => (data.qpos[joint] += clip(stopped[n] + rest[n], n)));
  }

  /** What the robot sees, or would see at its goal: [4, size, size] uint8, red, green, blue and depth. */
  look(data = this.data) {
    const { rgb, depth } = this.renderer.draw(data.geom_xpos, data.geom_xmat), [near, far] = this.task.depth_range;
    const image = new Uint8Array(rgb.length + depth.length);
    image.set(rgb);
    depth.forEach((metres, pixel) => {
      image[rgb.length + pixel] = Math.round(255 * Math.min(1, Math.max(0, (metres - near) / (far - near))));
    });
    return image;
  }

  /** Action of the policy: four numbers from -1 to 1. */
  async decide(observation, goal) {
    const size = this.task.scene.size, as = (image) => new this.Tensor("uint8", image, [1, 4, size, size]);
    const { action } = await this.session.run({ observation: as(observation), goal: as(goal) });
    return Array.from(action.data);
  }

  /** Move for one control step, as the task does. */
  act(action) {
    const { mujoco, model, data, task } = this, hand = task.hand;
    data.mocap_pos.set(this.body(data).map((value, axis) => value + task.action_scale * action[axis]));
    data.mocap_quat.set(task.down.map((value, i) => value + data.xquat[4 * hand + i]));
    for (let step = 0; step < task.substeps; step++) mujoco.mj_step(model, data);
    data.qpos.set(this.closed(Array.from(data.qpos)));
    mujoco.mj_kinematics(model, data);
  }

  /** Look, decide and act once. */
  async step() {
    this.observation = this.look();
    this.act(await this.decide(this.observation, this.goal));
  }
}

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** Solve a symmetric, positive linear system by elimination. */
function solveLinear(matrix, right) {
  const rows = matrix.map((row, i) => [...row, right[i]]), count = rows.length;
  for (let i = 0; i < count; i++) {
    for (let j = i + 1; j < count; j++) {
      const factor = rows[j][i] / rows[i][i];
      for (let k = i; k <= count; k++) rows[j][k] -= factor * rows[i][k];
    }
  }
  const solution = Array(count).fill(0);
  for (let i = count - 1; i >= 0; i--) {
    solution[i] = (rows[i][count] - rows[i].slice(i + 1, count).reduce((sum, value, k) => sum + value * solution[i + 1 + k], 0)) / rows[i][i];
  }
  return solution;
}
