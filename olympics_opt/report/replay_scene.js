// Replay, part 1: numbers. Unpacks the recorded states, turns joint angles into link poses and
// shapes into things to draw. No document here, so that it runs in node too.
// World frame: x forward, y left, z up. Matrices are row-major arrays of 9.
"use strict";

const ReplayScene = (() => {
  // ---- data -------------------------------------------------------------------------------
  function bytes(base64) {
    const text = atob(base64), out = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
    return out.buffer;
  }

  // A packed table keeps only the columns that change, as little-endian 16-bit steps.
  function unpack(packed) {
    const view = new DataView(bytes(packed.data)), k = packed.columns.length;
    const rows = [];
    for (let t = 0; t < packed.frames; t++) {
      const row = Float64Array.from(packed.base);
      for (let c = 0; c < k; c++)
        row[packed.columns[c]] += packed.step[c] * view.getUint16(2 * (t * k + c), true);
      rows.push(row);
    }
    return rows;
  }

  // Row of a table at time s (seconds): linear between frames, held at both ends.
  function at(rows, dt, s) {
    const x = Math.min(Math.max(s / dt, 0), rows.length - 1);
    const i = Math.min(Math.floor(x), Math.max(rows.length - 2, 0)), w = x - i;
    if (w === 0 || rows.length < 2) return rows[i];
    const a = rows[i], b = rows[i + 1], out = new Float64Array(a.length);
    for (let j = 0; j < a.length; j++) out[j] = a[j] + w * (b[j] - a[j]);
    return out;
  }

  // ---- kinematics -------------------------------------------------------------------------
  const mul = (a, b) => {
    const c = new Array(9);
    for (let i = 0; i < 9; i += 3)
      for (let j = 0; j < 3; j++) c[i + j] = a[i] * b[j] + a[i + 1] * b[j + 3] + a[i + 2] * b[j + 6];
    return c;
  };
  const turn = (R, p) => [
    R[0] * p[0] + R[1] * p[1] + R[2] * p[2],
    R[3] * p[0] + R[4] * p[1] + R[5] * p[2],
    R[6] * p[0] + R[7] * p[1] + R[8] * p[2],
  ];
  const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [
    a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
  ];
  const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
  const norm = (a) => Math.hypot(a[0], a[1], a[2]);
  const unit = (a) => scale(a, 1 / (norm(a) || 1));

  function fromQuat(q) {
    const n = Math.hypot(q[0], q[1], q[2], q[3]) || 1;
    const w = q[0] / n, x = q[1] / n, y = q[2] / n, z = q[3] / n;
    return [
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ];
  }

  // Rx(a) Ry(b) Rz(c): a link's three hinges in their order.
  function fromHinges(a, b, c) {
    const ca = Math.cos(a), sa = Math.sin(a), cb = Math.cos(b), sb = Math.sin(b);
    const cc = Math.cos(c), sc = Math.sin(c);
    return [
      cb * cc, -cb * sc, sb,
      ca * sc + sa * sb * cc, ca * cc - sa * sb * sc, -sa * cb,
      sa * sc - ca * sb * cc, sa * cc + ca * sb * sc, ca * cb,
    ];
  }

  // Poses {p, R} of every link of one athlete whose states begin at qpos[start].
  function linkPoses(links, qpos, start) {
    const poses = [];
    links.forEach((link, i) => {
      if (link.parent < 0) {
        const q = start;
        poses.push({
          p: [qpos[q], qpos[q + 1], qpos[q + 2]],
          R: fromQuat([qpos[q + 3], qpos[q + 4], qpos[q + 5], qpos[q + 6]]),
        });
        return;
      }
      const parent = poses[link.parent], h = start + 7 + 3 * (i - 1);
      poses.push({
        p: add(parent.p, turn(parent.R, link.offset)),
        R: mul(parent.R, fromHinges(qpos[h], qpos[h + 1], qpos[h + 2])),
      });
    });
    return poses;
  }

  // ---- shapes -----------------------------------------------------------------------------
  // Every shape becomes a ball {a, r}, a rod {a, b, r} (round ends) or a hull {corners, faces},
  // in the frame of its owner. Long ones are cut, so that sorting by depth stays true.
  const PIECE = 0.45;

  function box(center, half) {
    const corners = [];
    for (let i = 0; i < 8; i++)
      corners.push(center.map((c, k) => c + half[k] * ((i >> k) & 1 ? 1 : -1)));
    return {
      kind: "hull", corners,
      faces: [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]],
    };
  }

  // A box in pieces no longer than PIECE along its two longest axes.
  function boxes(center, half) {
    const order = [0, 1, 2].sort((i, k) => half[k] - half[i]), small = half.slice();
    const count = [1, 1, 1];
    for (const axis of order.slice(0, 2)) {
      count[axis] = Math.max(1, Math.ceil((2 * half[axis]) / PIECE));
      small[axis] = half[axis] / count[axis];
    }
    const out = [];
    for (let i = 0; i < count[0]; i++)
      for (let j = 0; j < count[1]; j++)
        for (let k = 0; k < count[2]; k++) {
          const step = [i, j, k];
          out.push(box(center.map((c, a) => c - half[a] + (2 * step[a] + 1) * small[a]), small));
        }
    return out;
  }

  function disc(a, b, r) {
    const axis = unit(sub(b, a)), n = 20, corners = [];
    const side = unit(cross(axis, Math.abs(axis[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0]));
    const other = cross(axis, side);
    for (const base of [a, b])
      for (let i = 0; i < n; i++) {
        const t = (2 * Math.PI * i) / n;
        corners.push(
          add(base, add(scale(side, r * Math.cos(t)), scale(other, r * Math.sin(t)))));
      }
    const ring = Array.from({ length: n }, (_, i) => i);
    const faces = [ring.slice().reverse(), ring.map((i) => i + n)];
    for (const i of ring) faces.push([i, (i + 1) % n, n + ((i + 1) % n), n + i]);
    return { kind: "hull", corners, faces };
  }

  function rods(a, b, r) {
    const count = Math.max(1, Math.ceil(norm(sub(b, a)) / PIECE));
    const point = (i) => add(scale(a, 1 - i / count), scale(b, i / count));
    return Array.from({ length: count }, (_, i) => ({ kind: "rod", a: point(i), b: point(i + 1), r }));
  }

  function parts(shape) {
    if (shape.kind === "box") return boxes(shape.center, shape.size);
    if (shape.kind === "sphere") return [{ kind: "ball", a: shape.center, r: shape.size[0] }];
    const long = norm(sub(shape.end, shape.center)) > 4 * shape.size[0];
    return shape.kind === "cylinder" && !long
      ? [disc(shape.center, shape.end, shape.size[0])]
      : rods(shape.center, shape.end, shape.size[0]);
  }

  function place(part, pose) {
    const to = (p) => add(pose.p, turn(pose.R, p));
    if (part.kind === "hull") return { ...part, corners: part.corners.map(to) };
    const out = { ...part, a: to(part.a) };
    if (part.kind === "rod") out.b = to(part.b);
    return out;
  }

  // Poses of the objects of a scene: bodies and balls from qpos, mocap ones from their table.
  function objectPoses(scene, qpos, mocap) {
    let free = scene.agents * (7 + 3 * (scene.links.length - 1)), fixture = 0;
    return scene.objects.map((o) => {
      if (o.motion === "free" || o.motion === "ball") {
        const q = free;
        free += 7;
        return {
          p: [qpos[q], qpos[q + 1], qpos[q + 2]],
          R: fromQuat([qpos[q + 3], qpos[q + 4], qpos[q + 5], qpos[q + 6]]),
        };
      }
      if (o.motion === "mocap") {
        const m = 3 * fixture++;
        return { p: [mocap[m], mocap[m + 1], mocap[m + 2]], R: fromQuat(o.quat) };
      }
      return { p: o.pos, R: fromQuat(o.quat) };
    });
  }

  return {
    unpack, at, linkPoses, objectPoses, parts, place, fromQuat,
    add, sub, dot, cross, scale, norm, unit, turn,
  };
})();

if (typeof module !== "undefined") module.exports = ReplayScene;
