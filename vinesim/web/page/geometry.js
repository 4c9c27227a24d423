// Base meshes of each kind of primitive in several levels of detail; the vertex shaders deform them.

/** Cone or cylinder with n sides; with ends or as an open tube. */
function tube(sides, closed, flat) {
  const points = [],
    faces = [];
  const ring = (z) => {
    const first = points.length / 3;
    for (let k = 0; k < sides; ++k)
      points.push(Math.cos((k / sides) * 2 * Math.PI), Math.sin((k / sides) * 2 * Math.PI), z);
    return first;
  };
  const low = ring(0),
    high = ring(1);
  for (let k = 0; k < sides; ++k) {
    const next = (k + 1) % sides;
    faces.push(low + k, low + next, high + next, low + k, high + next, high + k);
  }
  if (closed) {
    const rims = flat ? [ring(-1), ring(2)] : [low, high];
    const poles = [points.length / 3, points.length / 3 + 1];
    points.push(0, 0, -1, 0, 0, 2);
    for (let k = 0; k < sides; ++k) {
      const next = (k + 1) % sides;
      faces.push(poles[0], rims[0] + next, rims[0] + k, poles[1], rims[1] + k, rims[1] + next);
    }
  }
  return { points, faces };
}

/** Sphere of triangles: an octahedron subdivided repeatedly by halving its edges. */
function sphere(halvings) {
  const points = [
    [1, 0, 0],
    [-1, 0, 0],
    [0, 1, 0],
    [0, -1, 0],
    [0, 0, 1],
    [0, 0, -1],
  ];
  let faces = [
    [0, 2, 4],
    [2, 1, 4],
    [1, 3, 4],
    [3, 0, 4],
    [2, 0, 5],
    [1, 2, 5],
    [3, 1, 5],
    [0, 3, 5],
  ];
  for (let round = 0; round < halvings; ++round) {
    const known = new Map();
    const middle = (i, j) => {
      const key = Math.min(i, j) * 1e6 + Math.max(i, j);
      if (!known.has(key)) {
        const sum = points[i].map((x, axis) => x + points[j][axis]),
          length = Math.hypot(...sum);
        known.set(key, points.push(sum.map((x) => x / length)) - 1);
      }
      return known.get(key);
    };
    faces = faces.flatMap(([a, b, c]) => {
      const ab = middle(a, b),
        bc = middle(b, c),
        ca = middle(c, a);
      return [
        [a, ab, ca],
        [ab, b, bc],
        [ca, bc, c],
        [ab, bc, ca],
      ];
    });
  }
  return { points: points.flat(), faces: faces.flat() };
}

/** The coarsest sphere, with the apparent size of the octahedron. */
function tetrahedron() {
  const s = 0.8;
  return { points: [s, s, s, s, -s, -s, -s, s, -s, -s, -s, s], faces: [0, 1, 2, 0, 3, 1, 0, 2, 3, 1, 3, 2] };
}

/** Leaf blade; the arguments are the numbers of strips on each side of the midrib and along it. */
function blade(across, along) {
  const points = [],
    faces = [],
    columns = 2 * across + 1;
  for (let j = 0; j <= along; ++j) for (let i = 0; i < columns; ++i) points.push(i / across - 1, j / along, 0);
  for (let j = 0; j < along; ++j)
    for (let i = 0; i < columns - 1; ++i) {
      const k = j * columns + i;
      faces.push(k, k + 1, k + columns + 1, k, k + columns + 1, k + columns);
    }
  return { points, faces };
}

/** Cube; a doubled coordinate marks the axis of a vertex's normal. */
function cube() {
  const points = [],
    faces = [];
  for (let axis = 0; axis < 3; ++axis)
    for (const side of [-1, 1]) {
      const first = points.length / 3;
      for (const [u, v] of [
        [-1, -1],
        [1, -1],
        [1, 1],
        [-1, 1],
      ]) {
        const corner = [0, 0, 0];
        corner[axis] = 2 * side;
        corner[(axis + 1) % 3] = u * side;
        corner[(axis + 2) % 3] = v;
        points.push(...corner);
      }
      faces.push(first, first + 1, first + 2, first, first + 2, first + 3);
    }
  return { points, faces };
}

/** Largest distance of a mesh's faces inside the sphere of radius 1 that it approximates. */
const insideBall = ({ points, faces }) => {
  const at = (k) => points.slice(3 * k, 3 * k + 3),
    minus = (p, q) => p.map((x, axis) => x - q[axis]);
  let least = 1;
  for (let k = 0; k < faces.length; k += 3) {
    const [a, b, c] = [0, 1, 2].map((corner) => at(faces[k + corner])),
      u = minus(b, a),
      v = minus(c, a);
    const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    least = Math.min(least, Math.abs(normal.reduce((sum, x, axis) => sum + x * a[axis], 0)) / Math.hypot(...normal));
  }
  return 1 - least;
};
/** Largest distance of the faces of a cylinder's mesh inside the cylinder of radius 1. */
const insideTube = (sides) => 1 - Math.cos(Math.PI / sides);
const BALLS = [sphere(3), sphere(2), sphere(1)],
  SIDES = [16, 10, 6];

/**
 * Meshes by kind, in the order of the kinds' numbers (primitives.py), each from fine to coarse. `inside`: for round
 * bodies, distance of each level inside the true shape as a share of the radius.
 */
export const MESHES = [
  { name: "cone", levels: [tube(7, true, false), tube(4, false, false), tube(3, false, false)] },
  { name: "spheroid", levels: [sphere(2), sphere(1), sphere(0), tetrahedron()] },
  { name: "leaf", levels: [blade(2, 4), blade(1, 2), blade(1, 1), blade(0.5, 1)] },
  { name: "box", levels: [cube()] },
  { name: "ellipsoid", levels: BALLS, inside: BALLS.map(insideBall) },
  { name: "cylinder", levels: SIDES.map((sides) => tube(sides, true, true)), inside: SIDES.map(insideTube) },
  { name: "triangle", levels: [{ points: [0, 0, 0, 1, 0, 0, 2, 0, 0], faces: [0, 1, 2] }] },
];

/** A triangle around the circle of radius 1, for spheroids whose round shape a pixel's shader finds. */
export const BALL = {
  name: "ball",
  levels: [{ points: [0, 2, 0, -Math.sqrt(3), -1, 0, Math.sqrt(3), -1, 0], faces: [0, 1, 2] }],
};

/** Numbers of kinds. */
export const [, SPHEROID, LEAF, BOX, ELLIPSOID, , TRIANGLE] = MESHES.keys();
