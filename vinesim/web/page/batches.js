// Draws the primitives of one kind and level of detail in one draw call. An instance contains several copies of the
// primitive's mesh, because an instance costs as much as some dozens of triangles, mostly without a graphics card.

import * as THREE from "./vendor/three.module.js";
import { LIST_WIDTH } from "./shaders.js";

/** Approximate number of triangles of an instance. */
const BATCH = 128;
/** Row number of the unused copies in the last instance. */
const NOTHING = 0xffffffff;

export class Batches {
  /** `level`: points [3] and faces of the mesh of one primitive. */
  constructor({ points, faces }) {
    this.copies = Math.max(1, Math.floor(BATCH / (faces.length / 3)));
    this.seen = new RowList();
    this.unseen = new RowList();
    this.uniforms = { listed: { value: listTexture(new Uint32Array(LIST_WIDTH)) }, copies: { value: this.copies } };
    const vertices = points.length / 3,
      each = (make) => Array.from({ length: this.copies }, (_, k) => make(k)).flat();
    const copy = new THREE.BufferAttribute(Uint32Array.from(each((k) => Array(vertices).fill(k))), 1);
    copy.gpuType = THREE.IntType;
    const attributes = {
      position: new THREE.Float32BufferAttribute(
        each(() => points),
        3,
      ),
      copy,
    };
    this.geometry = geometryOf(
      attributes,
      each((k) => faces.map((vertex) => vertex + k * vertices)),
    );
    this.shadowGeometry = geometryOf(attributes, this.geometry.index);
  }

  clear() {
    this.seen.count = this.unseen.count = 0;
  }

  /** Number of triangles drawn in the picture for the eyes. */
  get triangles() {
    return (this.instances(this.seen.count) * this.geometry.index.count) / 3;
  }

  instances(count) {
    return Math.ceil(count / this.copies);
  }

  /** Draw the primitives in `seen` for the eyes and the sun, those in `unseen` only for the sun, until the next call. */
  update() {
    const { listed } = this.uniforms,
      { seen, unseen } = this,
      count = seen.count + unseen.count;
    const room = this.instances(count) * this.copies;
    if (listed.value.image.data.length < room) {
      listed.value.dispose();
      listed.value = listTexture(new Uint32Array(Math.ceil((2 * room) / LIST_WIDTH) * LIST_WIDTH));
    }
    const rows = listed.value.image.data;
    rows.set(seen.rows.subarray(0, seen.count));
    rows.set(unseen.rows.subarray(0, unseen.count), seen.count);
    rows.fill(NOTHING, count, room);
    listed.value.needsUpdate = true;
    this.geometry.instanceCount = this.instances(seen.count);
    this.shadowGeometry.instanceCount = this.instances(count);
  }
}

/** A list of rows of primitives whose memory is reused. */
class RowList {
  constructor() {
    this.rows = new Uint32Array(1024);
    this.count = 0;
  }

  /** Add primitives with consecutive rows. */
  add(row, size) {
    const end = this.count + size;
    if (end > this.rows.length) {
      const longer = new Uint32Array(2 * end);
      longer.set(this.rows);
      this.rows = longer;
    }
    for (let i = 0; i < size; ++i) this.rows[this.count + i] = row + i;
    this.count = end;
  }
}

function geometryOf(attributes, index) {
  const geometry = new THREE.InstancedBufferGeometry();
  for (const [name, values] of Object.entries(attributes)) geometry.setAttribute(name, values);
  geometry.setIndex(index);
  geometry.instanceCount = 0;
  return geometry;
}

function listTexture(list) {
  const texture = new THREE.DataTexture(
    list,
    LIST_WIDTH,
    list.length / LIST_WIDTH,
    THREE.RedIntegerFormat,
    THREE.UnsignedIntType,
  );
  texture.internalFormat = "R32UI";
  texture.minFilter = texture.magFilter = THREE.NearestFilter;
  return texture;
}
