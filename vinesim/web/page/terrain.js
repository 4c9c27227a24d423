// Uneven ground: its height under a place, and its triangles. Without nodes the ground is the plane z = 0.

import * as THREE from "./vendor/three.module.js";

/** Width of the ground that is drawn beyond the nodes [m]. */
const BEYOND = 300;

export class Terrain {
  /** `header.terrain`: position and distance of the nodes [m], number of columns, slope of the inclined plane along x and
   * y; null: none. `header.arrays.terrain`: heights of the nodes above the inclined plane [m], row by row along y. */
  constructor(header) {
    this.grid = header.terrain;
    this.residual = header.arrays.terrain;
    this.rows = this.grid === null ? 0 : this.residual.length / this.grid.columns;
  }

  /** Returns the residual of a node [m]; beyond the grid that of the nearest edge. */
  node(column, row) {
    const { columns } = this.grid,
      i = Math.min(Math.max(column, 0), columns - 1),
      j = Math.min(Math.max(row, 0), this.rows - 1);
    return this.residual[j * columns + i];
  }

  /** Returns the height of the ground [m], by the same triangles as in the physics. */
  height(x, y) {
    if (this.grid === null) return 0;
    const { x: left, y: near, cell, slope } = this.grid;
    const u = (x - left) / cell,
      v = (y - near) / cell,
      i = Math.floor(u),
      j = Math.floor(v),
      a = u - i,
      b = v - j;
    const low = this.node(i, j),
      high = this.node(i + 1, j + 1),
      right = this.node(i + 1, j),
      back = this.node(i, j + 1);
    const bend = a >= b ? a * (right - low) + b * (high - right) : a * (high - back) + b * (back - low);
    return slope[0] * x + slope[1] * y + low + bend;
  }

  /** Returns the triangles, with the rise along x and y in the attribute `rise`. */
  geometry() {
    if (this.grid === null) {
      const plane = new THREE.PlaneGeometry(2 * BEYOND, 2 * BEYOND, 1, 1);
      return plane.setAttribute("rise", new THREE.BufferAttribute(new Float32Array(8), 2));
    }
    const { x, y, cell, columns, slope } = this.grid,
      wide = columns + 2,
      deep = this.rows + 2; // one strip more on each side
    const place = new Float32Array(3 * wide * deep),
      rise = new Float32Array(2 * wide * deep),
      corners = new Uint32Array(6 * (wide - 1) * (deep - 1));
    const at = (start, k, count) => start + cell * (k - 1) + (k === 0 ? -BEYOND : k === count - 1 ? BEYOND : 0);
    for (let j = 0, k = 0; j < deep; ++j)
      for (let i = 0; i < wide; ++i, ++k) {
        const px = at(x, i, wide),
          py = at(y, j, deep);
        place.set([px, py, slope[0] * px + slope[1] * py + this.node(i - 1, j - 1)], 3 * k);
        const along = (this.node(i, j - 1) - this.node(i - 2, j - 1)) / (2 * cell),
          across = (this.node(i - 1, j) - this.node(i - 1, j - 2)) / (2 * cell);
        rise.set([slope[0] + along, slope[1] + across], 2 * k);
      }
    for (let j = 0, k = 0; j < deep - 1; ++j)
      for (let i = 0; i < wide - 1; ++i, k += 6) {
        const low = j * wide + i,
          high = low + wide + 1;
        corners.set([low, low + 1, high, low, high, high - 1], k);
      }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(place, 3));
    geometry.setAttribute("rise", new THREE.BufferAttribute(rise, 2));
    return geometry.setIndex(new THREE.BufferAttribute(corners, 1));
  }
}
