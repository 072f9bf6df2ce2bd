// The project's renderer for one still camera and shapes without textures: one ray through the centre of each pixel, the nearest
// of the shapes that it enters, and OpenGL's lighting there. Same frames and formulas as jaxrl_vis_envs/render/pixel. What stands
// still is drawn once.

const PLANE = 0, SPHERE = 2, CAPSULE = 3, ELLIPSOID = 4, CYLINDER = 5, BOX = 6; // mjtGeom
const SHORTEST = 1e-5; // m, half-size of a sheet

/** Lengths (m) that become 1 in the frame of a unit shape. */
function halfSizes(kind, [a, b, c]) {
  const half = { [PLANE]: [a, b, 1], [SPHERE]: [a, a, a], [CAPSULE]: [a, a, a], [CYLINDER]: [a, a, b] }[kind] ?? [a, b, c];
  return half.map((length) => Math.max(length, SHORTEST));
}

/** Depths at which a ray from o along r enters and leaves the infinite cylinder of radius 1 around z; null if it misses. */
function tube(o, r) {
  const inverse = 1 / (r[0] * r[0] + r[1] * r[1] + 1e-20);
  const middle = -(o[0] * r[0] + o[1] * r[1]) * inverse;
  const x = o[0] + middle * r[0], y = o[1] + middle * r[1];
  const square = (1 - x * x - y * y) * inverse;
  return square > 0 ? [middle - Math.sqrt(square), middle + Math.sqrt(square)] : null;
}

/** Depth at which a ray enters the unit ball around [0, 0, shift]; NaN if it misses. */
function ball(o, r, shift) {
  const z0 = o[2] - shift, inverse = 1 / (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]);
  const middle = -(o[0] * r[0] + o[1] * r[1] + z0 * r[2]) * inverse;
  const x = o[0] + middle * r[0], y = o[1] + middle * r[1], z = z0 + middle * r[2];
  return middle - Math.sqrt((1 - x * x - y * y - z * z) * inverse);
}

/** Depth at which a ray enters a unit shape; NaN if it misses. */
function enter(kind, o, r, long) {
  if (kind === PLANE) {
    const t = -o[2] / (r[2] + 1e-20);
    return Math.max(Math.abs(o[0] + t * r[0]), Math.abs(o[1] + t * r[1])) <= 1 ? t : NaN;
  }
  if (kind === BOX) {
    let first = -Infinity, last = Infinity;
    for (let axis = 0; axis < 3; axis++) {
      const inverse = 1 / (r[axis] + 1e-20), middle = -o[axis] * inverse, half = Math.abs(inverse);
      first = Math.max(first, middle - half);
      last = Math.min(last, middle + half);
    }
    return first < last ? first : NaN;
  }
  if (kind === CYLINDER) {
    const sides = tube(o, r);
    if (!sides) return NaN;
    const inverse = 1 / (r[2] + 1e-20), middle = -o[2] * inverse, half = Math.abs(inverse);
    const first = Math.max(sides[0], middle - half);
    return first < Math.min(sides[1], middle + half) ? first : NaN;
  }
  if (kind === CAPSULE) {
    const sides = tube(o, r);
    if (!sides) return NaN;
    const height = o[2] + sides[0] * r[2];
    return Math.abs(height) <= long ? sides[0] : ball(o, r, height > 0 ? long : -long);
  }
  return ball(o, r, 0); // sphere, ellipsoid
}

/** Gradient of a unit shape's surface at a point on it. */
function gradient(kind, [x, y, z], long) {
  if (kind === PLANE) return [0, 0, 1];
  if (kind === CAPSULE) return [x, y, z - Math.min(Math.max(z, -long), long)];
  if (kind === CYLINDER) return z * z >= x * x + y * y ? [0, 0, z] : [x, y, 0];
  if (kind !== BOX) return [x, y, z];
  const most = Math.max(Math.abs(x), Math.abs(y), Math.abs(z));
  return [x, y, z].map((value) => (Math.abs(value) < most ? 0 : value));
}

/** Images of one camera. */
export class Renderer {
  /**
   * @param scene Objects, camera and lights, from task.json.
   * @param size Height and width of the images, in pixels; those of the observations if not given.
   */
  constructor(scene, size = scene.size) {
    Object.assign(this, { scene, size });
    this.half = scene.objects.map(({ kind, size }) => halfSizes(kind, size));
    const column = (k) => scene.camera.axes.map((row) => row[k]);
    this.axes = [column(0), column(1), column(2)]; // right, up and back, in the world
    this.lens = Math.tan((scene.camera.fovy * Math.PI) / 360);
    this.lights = scene.lights.map(({ direction, ...light }) => {
      const world = this.axes.map((axis) => -dot(axis, direction));
      return { ...light, towards: scale(world, 1 / Math.hypot(...world)) };
    });
    this.lights.push({ ...scene.headlight, towards: [0, 0, 1] });
  }

  /** Point of the world [3] as a place [column, row] of the image, and its depth (m). */
  project(point) {
    const [x, y, z] = this.axes.map((axis) => dot(axis, minus(point, this.scene.camera.position)));
    const unit = (this.size / 2) / (-z * this.lens);
    return { column: this.size / 2 + x * unit, row: this.size / 2 - y * unit, depth: -z, pixelsPerMetre: unit };
  }

  /** Objects as unit shapes in the camera's frame: a point p of it is origin + axes p in the shape's. */
  place(positions, rotations) {
    return this.scene.objects.map(({ geom, kind, size }, index) => {
      const offset = minus(positions.subarray(3 * geom, 3 * geom + 3), this.scene.camera.position);
      const half = this.half[index], axes = [], origin = [];
      for (let i = 0; i < 3; i++) {
        const own = [rotations[9 * geom + i], rotations[9 * geom + 3 + i], rotations[9 * geom + 6 + i]];
        axes.push(this.axes.map((axis) => dot(own, axis) / half[i]));
        origin.push(-dot(own, offset) / half[i]);
      }
      return { index, kind, axes, origin, long: kind === CAPSULE ? size[1] / size[0] : 0, seen: this.window(positions, index) };
    });
  }

  /** Pixels [first column, last, first row, last] outside of which an object cannot be seen. */
  window(positions, index) {
    const { geom, kind, size: [a, b, c] } = this.scene.objects[index];
    const last = this.size - 1, { column, row, depth } = this.project(positions.subarray(3 * geom, 3 * geom + 3));
    const radius = kind === SPHERE ? a : kind === CAPSULE ? a + b : Math.hypot(a, b, kind === CYLINDER ? 0 : c);
    if (kind === PLANE || depth < 1.5 * radius) return [0, last, 0, last];
    // A ball's outline reaches farther from its centre than its radius at its depth, the more so the farther aside it is.
    const reach = 1.5 * (this.size / 2) * (radius / ((depth - radius) * this.lens)) + 1;
    return [column - reach, column + reach, row - reach, row + reach];
  }

  /**
   * Draw an image.
   *
   * @param positions, rotations Poses of all geoms: 3 and 9 numbers each, m in the world.
   * @returns {{rgb: Uint8Array, depth: Float64Array}} [3, size, size] planar, and [size, size] in m along the camera's axis.
   */
  draw(positions, rotations) {
    const shapes = this.place(positions, rotations), moves = ({ index }) => this.scene.objects[index].moves;
    this.still ??= this.drawOver(this.empty(), shapes.filter((shape) => !moves(shape)));
    const image = { rgb: this.still.rgb.slice(), depth: this.still.depth.slice() };
    return this.drawOver(image, shapes.filter(moves));
  }

  /** Image of nothing: the sky. */
  empty() {
    const count = this.size * this.size, rgb = new Uint8Array(3 * count);
    this.scene.sky?.forEach((value, k) => rgb.fill(value, k * count, (k + 1) * count));
    return { rgb, depth: new Float64Array(count).fill(this.scene.zfar) };
  }

  /** Draw shapes into an image, where they are nearer than what is there. */
  drawOver(image, shapes) {
    const { size, lens, scene } = this, count = size * size, last = size - 1;
    const end = (index, most) => most(...shapes.map(({ seen }) => Math.min(Math.max(seen[index], 0), last)));
    const [left, right] = [Math.floor(end(0, Math.min)), Math.ceil(end(1, Math.max))];
    const [top, bottom] = [Math.floor(end(2, Math.min)), Math.ceil(end(3, Math.max))];
    const ray = [0, 0, 0];
    for (let row = top; row <= bottom; row++) {
      const v = ((size - 1 - 2 * row) / size) * lens;
      for (let column = left; column <= right; column++) {
        const u = ((2 * column + 1 - size) / size) * lens, pixel = row * size + column;
        let nearest = image.depth[pixel], shape = null;
        for (const one of shapes) {
          const { seen, axes } = one;
          if (column < seen[0] || column > seen[1] || row < seen[2] || row > seen[3]) continue;
          for (let i = 0; i < 3; i++) ray[i] = axes[i][0] * u + axes[i][1] * v - axes[i][2];
          const t = enter(one.kind, one.origin, ray, one.long);
          if (t > scene.znear && t < nearest) [nearest, shape] = [t, one];
        }
        if (!shape) continue;
        image.depth[pixel] = nearest;
        this.light(shape, u, v, nearest).forEach((value, k) => (image.rgb[k * count + pixel] = value));
      }
    }
    return image;
  }

  /** Depth (m) of what moves alone, in front of what is nearer than `behind`; elsewhere that. */
  outline(positions, rotations, behind) {
    const moving = this.place(positions, rotations).filter(({ index }) => this.scene.objects[index].moves);
    return this.drawOver({ rgb: new Uint8Array(3 * behind.length), depth: behind.slice() }, moving).depth;
  }

  /** Colour of a shape at a depth along a ray, from 0 to 255. */
  light(shape, u, v, depth) {
    const point = shape.axes.map((a, i) => shape.origin[i] + depth * (a[0] * u + a[1] * v - a[2]));
    let slope = gradient(shape.kind, point, shape.long);
    if (shape.kind === PLANE && shape.origin[2] < 0) slope = [0, 0, -1]; // towards the camera
    const normal = [0, 1, 2].map((k) => shape.axes[0][k] * slope[0] + shape.axes[1][k] * slope[1] + shape.axes[2][k] * slope[2]);
    const length = Math.hypot(...normal) || 1, { rgba, emission } = this.scene.objects[shape.index];
    return [0, 1, 2].map((k) => {
      let sum = emission;
      for (const { ambient, diffuse, towards } of this.lights) {
        sum += ambient[k] + diffuse[k] * Math.max(0, dot(normal, towards) / length);
      }
      return Math.floor(255 * Math.min(1, Math.max(0, sum * rgba[k])) + 0.5);
    });
  }
}

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
