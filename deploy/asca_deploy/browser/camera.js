/** A camera that turns around a point on the ground; z is up, metres. Matrices are column by column, as WebGL's. */

const FIELD_OF_VIEW = (45 * Math.PI) / 180;
const STEEPEST = (89 * Math.PI) / 180;

export class OrbitCamera {
  constructor() {
    this.reset();
  }

  /** Behind and above the sensor, looking ahead along x. */
  reset() {
    Object.assign(this, { target: [22, 0, 0], azimuth: Math.PI, elevation: 0.5, distance: 52 });
  }

  turn(dx, dy) {
    this.azimuth -= dx * 0.006;
    this.elevation = Math.min(Math.max(this.elevation + dy * 0.006, 0.02), STEEPEST);
  }

  /** Move the target along the ground, by as much as the pointer moved over it, about. */
  move(dx, dy) {
    const scale = this.distance * 0.0014;
    const [cos, sin] = [Math.cos(this.azimuth), Math.sin(this.azimuth)];
    this.target[0] += (sin * dx - cos * dy) * scale;
    this.target[1] += (-cos * dx - sin * dy) * scale;
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 2), 300);
  }

  /** View and projection (16 numbers) for a picture of this width over height. */
  matrix(aspect) {
    const [x, y, z] = this.target;
    const [cosE, sinE] = [Math.cos(this.elevation), Math.sin(this.elevation)];
    const back = [Math.cos(this.azimuth) * cosE, Math.sin(this.azimuth) * cosE, sinE];
    const right = [-Math.sin(this.azimuth), Math.cos(this.azimuth), 0];
    const up = [-Math.cos(this.azimuth) * sinE, -Math.sin(this.azimuth) * sinE, cosE];
    const eye = [x, y, z].map((value, axis) => value + back[axis] * this.distance);
    const rows = [right, up, back].map((axis) => [...axis, -axis.reduce((sum, a, i) => sum + a * eye[i], 0)]);
    const [near, far] = [0.2, 600];
    const focal = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const clip = [
      rows[0].map((value) => (value * focal) / aspect),
      rows[1].map((value) => value * focal),
      rows[2].map((value, i) => (value * (far + near) + (i === 3 ? 2 * far * near : 0)) / (near - far)),
      rows[2].map((value) => -value),
    ];
    return Float32Array.from({ length: 16 }, (_, i) => clip[i % 4][Math.floor(i / 4)]);
  }
}

/** Where a point in metres is on a picture of width x height pixels, or null behind the camera. */
export function project(matrix, [x, y, z], width, height) {
  const [right, up, , depth] = [0, 1, 2, 3].map(
    (row) => matrix[row] * x + matrix[row + 4] * y + matrix[row + 8] * z + matrix[row + 12],
  );
  if (depth <= 0) return null;
  return [((right / depth + 1) / 2) * width, ((1 - up / depth) / 2) * height];
}
