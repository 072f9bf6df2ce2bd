// The page that plays: a policy, its robot and a goal to drag. Nothing is sent anywhere.

import { Reach } from "./reach.js";
import { Renderer } from "./renderer.js";

const DATA = new URL("data/", import.meta.url);
const GREEN = [62, 207, 142], LIGHT = [244, 245, 247];
const VIEW = 320; // pixels, of the large view
const VIEW_AT = [1.1, 0.75, 0.56], DISTANCE = 1.8, AZIMUTH = 0.65, ELEVATION = 0.38; // m, rad
const WHEEL = 0.0004; // m per unit of a mouse's wheel
const place = document.getElementById("reach");

/** Camera that looks at VIEW_AT from beside the task's own. */
function viewCamera() {
  const back = [Math.cos(ELEVATION) * Math.cos(AZIMUTH), Math.cos(ELEVATION) * Math.sin(AZIMUTH), Math.sin(ELEVATION)];
  const right = [-Math.sin(AZIMUTH), Math.cos(AZIMUTH), 0];
  const up = [0, 1, 2].map((i) => back[(i + 1) % 3] * right[(i + 2) % 3] - back[(i + 2) % 3] * right[(i + 1) % 3]);
  const axes = [0, 1, 2].map((i) => [right[i], up[i], back[i]]);
  return { position: VIEW_AT.map((value, i) => value + DISTANCE * back[i]), axes, fovy: 42 };
}

async function load() {
  const response = await fetch(new URL("task.json", DATA));
  if (!response.ok) throw new Error("this site was built without the page's data: `make page`, then `make docs`");
  const [{ default: loadMujoco }, ort, task] = await Promise.all([
    import(new URL("vendor/mujoco.js", DATA).href),
    import(new URL("vendor/ort.wasm.min.mjs", DATA).href),
    response.json(),
  ]);
  ort.env.wasm.wasmPaths = new URL("vendor/", DATA).href;
  ort.env.wasm.numThreads = 1; // several would need headers of the server
  const [mujoco, session] = await Promise.all([loadMujoco(), ort.InferenceSession.create(new URL("policy.onnx", DATA).href)]);
  return new Reach(mujoco, session, ort.Tensor, task);
}

/** Show the image [channels, size, size] on a canvas, colours beside depth. */
function show(canvas, image, size) {
  const count = size * size, both = new ImageData(2 * size, size);
  for (let pixel = 0; pixel < count; pixel++) {
    const at = 4 * (2 * size * Math.floor(pixel / size) + (pixel % size));
    const depth = 255 - image[3 * count + pixel];
    both.data.set([image[pixel], image[count + pixel], image[2 * count + pixel], 255], at);
    both.data.set([depth, depth, depth, 255], at + 4 * size);
  }
  [canvas.width, canvas.height] = [2 * size, size];
  canvas.getContext("2d").putImageData(both, 0, 0);
}

class Page {
  constructor(reach) {
    this.reach = reach;
    const { scene } = reach.task;
    const light = ({ kind, rgba, ...object }) => ({ ...object, kind, rgba: kind === 0 ? [1, 1, 1, 1] : rgba });
    this.view = new Renderer({ ...scene, objects: scene.objects.map(light), sky: LIGHT, camera: viewCamera() }, VIEW);
    place.innerHTML = `
      <div class="reach-view"><canvas width="${VIEW}" height="${VIEW}" tabindex="0"
        aria-label="The robot; drag to move its goal, or use the arrow keys and Page Up and Down"></canvas></div>
      <div class="reach-side">
        <p>Goal, as the robot sees it</p><canvas></canvas>
        <p>Now, as the robot sees it</p><canvas></canvas>
        <p class="reach-status" role="status"></p>
        <p><button class="md-button" data-do="goal">New goal</button> <button class="md-button" data-do="reset">Reset the robot</button></p>
      </div>`;
    [this.canvas, this.goalCanvas, this.nowCanvas] = place.querySelectorAll("canvas");
    this.status = place.querySelector(".reach-status");
    place.querySelector("[data-do=goal]").onclick = () => this.drawGoal();
    place.querySelector("[data-do=reset]").onclick = () => (this.wantsReset = true);
    this.listen();
    this.drawGoal();
  }

  /** Move the goal with the pointer, in the plane through it that faces the viewer; the wheel moves it towards or away. */
  listen() {
    const { canvas, view } = this, [right, up, back] = view.axes;
    const move = (along, metres) => (this.wanted = this.wanted.map((value, i) => value + metres * along[i]));
    const clip = () => {
      const [low, high] = this.reach.task.goal_box;
      this.wanted = this.wanted.map((value, i) => Math.min(Math.max(value, low[i]), high[i]));
    };
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.dragged = [event.clientX, event.clientY];
    };
    canvas.onpointermove = (event) => {
      if (!this.dragged) return;
      const metre = view.project(this.wanted).pixelsPerMetre * (canvas.clientWidth / VIEW);
      move(right, (event.clientX - this.dragged[0]) / metre);
      move(up, (this.dragged[1] - event.clientY) / metre);
      this.dragged = [event.clientX, event.clientY];
    };
    canvas.onpointerup = canvas.onpointercancel = () => {
      this.dragged = null;
      clip();
    };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      move(back, WHEEL * event.deltaY);
      clip();
    }, { passive: false });
    const keys = { ArrowLeft: [right, -1], ArrowRight: [right, 1], ArrowDown: [up, -1], ArrowUp: [up, 1], PageUp: [back, -1], PageDown: [back, 1] };
    canvas.onkeydown = (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      const [along, sign] = keys[event.key];
      move(along, 0.02 * sign);
      clip();
    };
  }

  drawGoal() {
    const [low, high] = this.reach.task.goal_box;
    this.wanted = low.map((value, i) => value + Math.random() * (high[i] - value));
  }

  /** Act for good, in real time. */
  async run() {
    const period = 1000 * this.reach.task.control_period;
    for (let due = performance.now(); ; due = Math.max(due + period, performance.now())) {
      await this.advance();
      await new Promise((done) => setTimeout(done, Math.max(0, due + period - performance.now())));
    }
  }

  async advance() {
    const { reach } = this;
    if (this.wantsReset) reach.reset();
    this.wantsReset = false;
    if (String(this.wanted) !== this.aimed) {
      this.aimed = String(this.wanted);
      reach.aim(this.wanted);
      show(this.goalCanvas, reach.goal, reach.task.scene.size);
    }
    await reach.step();
    show(this.nowCanvas, reach.observation, reach.task.scene.size);
    this.draw();
    const distance = reach.distance(), isReached = distance <= reach.task.threshold;
    this.status.textContent = `${isReached ? "Reached" : "On its way"}: ${(100 * distance).toFixed(1)} cm from the goal`;
    this.status.classList.toggle("reached", isReached);
  }

  /** Draw the large view: the robot, the translucent one at its goal, and a ring around the goal. */
  draw() {
    const { view, canvas, reach } = this, { data, goalData } = reach, count = VIEW * VIEW;
    const { rgb, depth } = view.draw(data.geom_xpos, data.geom_xmat);
    const ghost = view.outline(goalData.geom_xpos, goalData.geom_xmat, depth), image = new ImageData(VIEW, VIEW);
    for (let pixel = 0; pixel < count; pixel++) {
      const share = ghost[pixel] < depth[pixel] - 0.002 ? 0.4 : 0;
      for (let k = 0; k < 3; k++) image.data[4 * pixel + k] = (1 - share) * rgb[k * count + pixel] + share * GREEN[k];
      image.data[4 * pixel + 3] = 255;
    }
    const context = canvas.getContext("2d"), { column, row, pixelsPerMetre } = view.project(reach.grip(goalData));
    context.putImageData(image, 0, 0);
    context.strokeStyle = `rgb(${GREEN})`;
    context.lineWidth = 3;
    context.beginPath();
    context.arc(column, row, reach.task.threshold * pixelsPerMetre, 0, 2 * Math.PI);
    context.stroke();
  }
}

async function main() {
  place.textContent = "Loading physics and policy (28 MB) ...";
  try {
    const reach = await load();
    if (location.search === "?check") {
      const { check } = await import("./check.js");
      const golden = await (await fetch(new URL("golden.json", DATA))).json();
      place.textContent = "Checking ...";
      const result = JSON.stringify(await check(reach, golden));
      place.textContent = result;
      await fetch("/result", { method: "POST", body: result });
      return;
    }
    const page = new Page(reach);
    window.reachPage = page; // for the console
    await page.run();
  } catch (error) {
    place.textContent = `The page does not run: ${error.message}`;
    if (location.search === "?check") await fetch("/result", { method: "POST", body: JSON.stringify({ error: String(error.stack) }) });
  }
}

main();
