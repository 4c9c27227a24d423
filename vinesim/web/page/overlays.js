// Overlays, drawn on demand: contact forces, areas of interest, and owners.

import * as THREE from "./vendor/three.module.js";

const KINDS = {
  KeyC: ["forces", "contact forces"],
  KeyI: ["interest", "areas of interest"],
  KeyO: ["owners", "owners"],
};
const METRES_PER_NEWTON = 0.02,
  SHORTEST = 0.04,
  CORNERS = 64;

export class Overlays {
  /** Draws into the group of the `world`, which has the world's axes. */
  constructor(world) {
    this.world = world;
    this.shown = new Set();
    this.forces = lines(0xff8c1a);
    this.interest = lines(0x3d8bff);
    world.group.add(this.forces, this.interest);
    this.panel = document.getElementById("overlays");
    this.labels = new Map();
    this.buttons = {};
    for (const [code, [name, text]] of Object.entries(KINDS)) {
      const button = this.panel.appendChild(document.createElement("button"));
      this.buttons[name] = button;
      button.innerHTML = `<kbd class="keys">${code.slice(3)}</kbd> ${text}`;
      button.setAttribute("aria-pressed", "false");
      button.addEventListener("click", () => {
        this.toggle(name);
        button.blur();
      });
    }
    this.state = null;
  }

  press(code) {
    if (code in KINDS) this.toggle(KINDS[code][0]);
  }

  toggle(name) {
    if (!this.shown.delete(name)) this.shown.add(name);
    this.buttons[name].setAttribute("aria-pressed", String(this.shown.has(name)));
  }

  /** Whether overlays are shown, for which the client must send forces and owners. */
  get areShown() {
    return this.shown.size > 0;
  }

  take(state) {
    if (state.owners) this.state = state;
  }

  /** Draw the newest overlays; `actors` with their carriers. */
  draw(actors, camera) {
    const { state } = this;
    this.forces.visible = this.shown.has("forces") && state !== null;
    this.interest.visible = this.shown.has("interest");
    if (this.forces.visible) fill(this.forces, arrows(state.arrays.contact_place, state.arrays.contact_force));
    if (this.interest.visible)
      fill(
        this.interest,
        circles(
          actors.map(({ carrier }) => this.world.place(carrier)),
          this.world.header.interest,
        ),
      );
    this.label(this.shown.has("owners") && state !== null ? state.owners : {}, camera);
  }

  label(owners, camera) {
    const names = document.getElementById("names");
    for (const [name, label] of this.labels)
      if (!(name in owners)) {
        label.remove();
        this.labels.delete(name);
      }
    for (const [name, owner] of Object.entries(owners)) {
      const point = this.place(name);
      if (point === null) continue;
      point.applyEuler(this.world.group.rotation).project(camera);
      if (!this.labels.has(name)) this.labels.set(name, names.appendChild(document.createElement("div")));
      const label = this.labels.get(name);
      label.className = "owner";
      label.textContent = `${name}: ${owner}`;
      label.hidden = point.z > 1;
      const x = ((point.x + 1) / 2) * innerWidth,
        y = ((1 - point.y) / 2) * innerHeight;
      label.style.transform = `translate(${x}px, ${y}px) translate(-50%, -100%)`;
    }
  }

  /** Returns the position [3] of a tree, box or bunch; null: not loaded. */
  place(name) {
    const [kind, index] = name.split("/"),
      { world } = this;
    if (kind === "tree") return world.place(world.header.arrays.tree_first[index]).add(new THREE.Vector3(0, 0, 0.4));
    const row = world.names.indexOf(name);
    return row < 0 ? null : world.place(world.bodies + 1 + row).add(new THREE.Vector3(0, 0, 0.3));
  }
}

function lines(color) {
  const mesh = new THREE.LineSegments(
    new THREE.BufferGeometry(),
    new THREE.LineBasicMaterial({ color, depthTest: false, transparent: true }),
  );
  mesh.frustumCulled = false;
  mesh.renderOrder = 2;
  mesh.visible = false;
  return mesh;
}

function fill(mesh, points) {
  const known = mesh.geometry.getAttribute("position");
  if (known && known.array.length >= points.length) {
    known.array.set(points);
    known.needsUpdate = true;
  } else {
    mesh.geometry.dispose();
    mesh.geometry = new THREE.BufferGeometry();
    mesh.geometry.setAttribute("position", new THREE.Float32BufferAttribute([...points, ...points], 3));
  }
  mesh.geometry.setDrawRange(0, points.length / 3);
}

/** Returns pairs of points of arrows that show forces [k, 3] N at places [k, 3]. */
function arrows(place, force) {
  const points = [];
  for (let k = 0; k < place.length; k += 3) {
    const from = new THREE.Vector3(place[k], place[k + 1], place[k + 2]);
    const way = new THREE.Vector3(force[k], force[k + 1], force[k + 2]);
    const length = way.length();
    if (length < 1e-3) continue;
    way.multiplyScalar(Math.max(METRES_PER_NEWTON, SHORTEST / length));
    const to = from.clone().add(way),
      back = way.clone().multiplyScalar(-0.25);
    const side = new THREE.Vector3(way.y, -way.x, 0);
    if (side.length() < 1e-6) side.set(1, 0, 0);
    side.setLength(0.1 * way.length());
    points.push(...from, ...to, ...to, ...to.clone().add(back).add(side), ...to, ...to.clone().add(back).sub(side));
  }
  return points;
}

/** Returns pairs of points of circles on the ground. */
function circles(centres, radius) {
  const points = [];
  for (const { x, y } of centres)
    for (let k = 0; k < 2 * CORNERS; ++k) {
      const angle = (Math.ceil(k / 2) / CORNERS) * 2 * Math.PI;
      points.push(x + radius * Math.cos(angle), y + radius * Math.sin(angle), 0.05);
    }
  return points;
}
