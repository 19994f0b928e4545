// Replay, part 2: the picture, on a plain 2-D canvas. Shapes are drawn from far to near; a rod is
// its outline with the shading of a cylinder across it, a ball a shaded disc, a hull its visible
// faces. Colours of sky and ground come from the page's style sheet.
"use strict";

const ReplayDraw = (() => {
  const S = ReplayScene;
  const SUN = S.unit([-0.28, -0.42, 0.86]);
  const NEAR = 0.25, LENS = 2.1; // focal length over the picture's half height

  // ---- camera -----------------------------------------------------------------------------
  function camera(view, target, width, height) {
    const c = Math.cos(view.yaw), s = Math.sin(view.yaw);
    const cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const into = [c * cp, s * cp, -sp], right = [s, -c, 0], up = S.cross(right, into);
    const eye = S.sub(target, S.scale(into, view.distance));
    const f = (LENS * Math.min(height, width)) / 2;
    return {
      into, right, up, eye, f, width, height,
      depth: (p) => S.dot(S.sub(p, eye), into),
      project(p) {
        const d = S.sub(p, eye), z = S.dot(d, into);
        return [width / 2 + (f * S.dot(d, right)) / z, height / 2 - (f * S.dot(d, up)) / z, z];
      },
    };
  }

  // A polygon cut at the near plane and projected.
  function clipped(cam, points) {
    const out = [];
    points.forEach((a, i) => {
      const b = points[(i + 1) % points.length], za = cam.depth(a), zb = cam.depth(b);
      if (za > NEAR) out.push(cam.project(a));
      if (za > NEAR !== zb > NEAR) {
        const w = (NEAR - za) / (zb - za);
        out.push(cam.project(S.add(S.scale(a, 1 - w), S.scale(b, w))));
      }
    });
    return out;
  }

  function trace(ctx, points) {
    points.forEach((p, i) => (i ? ctx.lineTo(p[0], p[1]) : ctx.moveTo(p[0], p[1])));
  }

  // ---- light ------------------------------------------------------------------------------
  const parse = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  function shade(color, normal, toEye) {
    const lit = Math.max(0, S.dot(normal, SUN)), sky = 0.5 + 0.5 * normal[2];
    const rim = Math.max(0, 1 - Math.max(0, S.dot(normal, toEye))) ** 3;
    const k = 0.5 + 0.2 * sky + 0.42 * lit - 0.3 * rim;
    return `rgb(${color.map((c) => Math.round(Math.min(255, c * k))).join(",")})`;
  }

  // ---- solids -----------------------------------------------------------------------------
  function drawBall(ctx, cam, part, color) {
    const [x, y, z] = cam.project(part.a), r = (cam.f * part.r) / z;
    const toEye = S.unit(S.sub(cam.eye, part.a));
    // The brightest point lies between the sun and the eye.
    const peak = S.unit(S.add(SUN, S.scale(toEye, 1.2)));
    const px = S.dot(peak, cam.right) * r * 0.8, py = -S.dot(peak, cam.up) * r * 0.8;
    const fill = ctx.createRadialGradient(x + px, y + py, 0, x, y, r * 1.02);
    const dark = S.unit(S.sub(S.scale(toEye, 0.35), S.scale(SUN, 0.5)));
    fill.addColorStop(0, shade(color, peak, toEye));
    fill.addColorStop(0.55, shade(color, S.unit(S.add(peak, S.scale(toEye, 0.2))), toEye));
    fill.addColorStop(1, shade(color, dark, toEye));
    ctx.fillStyle = fill;
    ctx.beginPath();
    ctx.arc(x, y, r, 0, 2 * Math.PI);
    ctx.fill();
  }

  function drawRod(ctx, cam, part, color) {
    const a = cam.project(part.a), b = cam.project(part.b);
    const ra = (cam.f * part.r) / a[2], rb = (cam.f * part.r) / b[2];
    const length = Math.hypot(b[0] - a[0], b[1] - a[1]);
    if (length < 0.6 * Math.max(ra, rb)) {
      const ends = [{ ...part, kind: "ball" }, { ...part, kind: "ball", a: part.b }];
      if (a[2] < b[2]) ends.reverse();
      return ends.forEach((end) => drawBall(ctx, cam, end, color));
    }
    const base = Math.atan2(b[1] - a[1], b[0] - a[0]);
    const open = Math.acos(Math.max(-1, Math.min(1, (ra - rb) / length)));
    const sx = -Math.sin(base), sy = Math.cos(base), r = Math.max(ra, rb);
    const x = (a[0] + b[0]) / 2, y = (a[1] + b[1]) / 2;
    const side = S.sub(S.scale(cam.right, sx), S.scale(cam.up, sy));
    const toEye = S.unit(S.sub(cam.eye, S.scale(S.add(part.a, part.b), 0.5)));
    let front = S.unit(S.cross(S.sub(part.b, part.a), side));
    if (S.dot(front, toEye) < 0) front = S.scale(front, -1);
    const fill = ctx.createLinearGradient(x - sx * r, y - sy * r, x + sx * r, y + sy * r);
    for (const s of [-1, -0.75, -0.4, 0, 0.4, 0.75, 1]) {
      const n = S.add(S.scale(side, s), S.scale(front, Math.sqrt(1 - s * s)));
      fill.addColorStop((s + 1) / 2, shade(color, n, toEye));
    }
    ctx.fillStyle = fill;
    ctx.beginPath();
    ctx.arc(a[0], a[1], ra, base + open, base + 2 * Math.PI - open);
    ctx.arc(b[0], b[1], rb, base - open, base + open);
    ctx.closePath();
    ctx.fill();
  }

  // A piece of a net: a veil and its strings, across its two longer edges.
  const MESH = 0.12;
  function drawNet(ctx, cam, part, color) {
    const corner = part.corners, at = corner[0];
    const edges = [1, 2, 4].map((i) => S.sub(corner[i], at)).sort((a, b) => S.norm(b) - S.norm(a));
    const [u, v, w] = edges, base = S.add(at, S.scale(w, 0.5)), alpha = ctx.globalAlpha;
    const point = (a, b) => cam.project(S.add(base, S.add(S.scale(u, a), S.scale(v, b))));
    ctx.fillStyle = ctx.strokeStyle = `rgb(${color.join(",")})`;
    ctx.lineWidth = 0.8;
    ctx.globalAlpha = 0.3 * alpha;
    ctx.beginPath();
    trace(ctx, [point(0, 0), point(1, 0), point(1, 1), point(0, 1)]);
    ctx.fill();
    ctx.globalAlpha = 0.8 * alpha;
    ctx.beginPath();
    for (const [n, line] of [
      [Math.max(1, Math.round(S.norm(u) / MESH)), (k) => [point(k, 0), point(k, 1)]],
      [Math.max(1, Math.round(S.norm(v) / MESH)), (k) => [point(0, k), point(1, k)]],
    ])
      for (let i = 0; i <= n; i++) trace(ctx, line(i / n));
    ctx.stroke();
    ctx.globalAlpha = alpha;
  }

  function drawHull(ctx, cam, part, color) {
    if (part.net) return drawNet(ctx, cam, part, color);
    const middle = S.scale(part.corners.reduce(S.add), 1 / part.corners.length);
    const screen = part.corners.map(cam.project);
    ctx.lineWidth = 0.7;
    ctx.lineJoin = "round";
    for (const face of part.faces) {
      const [p, q, s] = face.map((i) => part.corners[i]);
      let n = S.unit(S.cross(S.sub(q, p), S.sub(s, q)));
      if (S.dot(n, S.sub(p, middle)) < 0) n = S.scale(n, -1);
      const toEye = S.unit(S.sub(cam.eye, p));
      if (S.dot(n, toEye) <= 0) continue;
      ctx.fillStyle = ctx.strokeStyle = shade(color, n, n); // flat: no darkening at the rim
      ctx.beginPath();
      trace(ctx, face.map((i) => screen[i]));
      ctx.closePath();
      ctx.fill();
      ctx.stroke();
    }
  }

  const points = (part) =>
    part.kind === "hull" ? part.corners : part.kind === "rod" ? [part.a, part.b] : [part.a];
  const center = (part) => {
    const all = points(part);
    return S.scale(all.reduce(S.add), 1 / all.length);
  };
  const DRAW = { ball: drawBall, rod: drawRod, hull: drawHull };

  // ---- shadows ----------------------------------------------------------------------------
  // Outline of the points, counter-clockwise (Andrew's monotone chain), on the ground.
  function outline(cloud) {
    cloud.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    const half = (list) => {
      const out = [];
      for (const p of list) {
        while (out.length > 1) {
          const [a, b] = out.slice(-2);
          if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
          out.pop();
        }
        out.push(p);
      }
      out.pop();
      return out;
    };
    return [...half(cloud), ...half(cloud.slice().reverse())];
  }

  function shadow(part) {
    const cloud = [];
    for (const p of points(part)) {
      const k = p[2] / SUN[2], x = p[0] - SUN[0] * k, y = p[1] - SUN[1] * k;
      if (part.kind === "hull") cloud.push([x, y]);
      else
        for (let i = 0; i < 10; i++) {
          const t = (Math.PI * i) / 5;
          cloud.push([x + part.r * Math.cos(t), y + part.r * Math.sin(t)]);
        }
    }
    return outline(cloud).map((p) => [p[0], p[1], 0]);
  }

  // Waves as quadrangles from far to near, paler on their crests.
  function drawTerrain(ctx, cam, terrain) {
    const { low, high, heights } = terrain, rows = heights.length, columns = heights[0].length;
    const color = parse(terrain.color), flat = SUN[2];
    const point = (r, c) => [
      low[0] + ((high[0] - low[0]) * c) / (columns - 1),
      low[1] + ((high[1] - low[1]) * r) / (rows - 1),
      heights[r][c],
    ];
    const quads = [];
    for (let r = 0; r + 1 < rows; r++)
      for (let c = 0; c + 1 < columns; c++) {
        const p = [point(r, c), point(r, c + 1), point(r + 1, c + 1), point(r + 1, c)];
        quads.push([S.norm(S.sub(p[0], cam.eye)), p]);
      }
    quads.sort((a, b) => b[0] - a[0]);
    ctx.lineWidth = 0.7;
    for (const [, p] of quads) {
      const shape = clipped(cam, p);
      if (shape.length < 3) continue;
      const n = S.unit(S.cross(S.sub(p[2], p[0]), S.sub(p[3], p[1])));
      const k = (0.45 + (0.55 * Math.max(0, S.dot(n, SUN))) / flat) * (1 + 0.2 * p[0][2]);
      ctx.fillStyle = ctx.strokeStyle = `rgb(${color.map((v) => Math.round(Math.min(255, v * k))).join(",")})`;
      ctx.beginPath();
      trace(ctx, shape);
      ctx.closePath();
      ctx.fill();
      ctx.stroke();
    }
  }

  function drawGround(ctx, cam, scene, target, theme, distance) {
    if (scene.terrain) drawTerrain(ctx, cam, scene.terrain);
    for (const mark of scene.marks) {
      const shape = clipped(cam, mark.corners.map((c) => [c[0], c[1], c[2] || 0]));
      if (shape.length < 3) continue;
      ctx.fillStyle = mark.color;
      ctx.globalAlpha = theme.paint;
      ctx.beginPath();
      trace(ctx, shape);
      ctx.fill();
    }
    ctx.globalAlpha = 1;
    drawLabels(ctx, cam, scene, theme, distance);
    if (scene.terrain) return;
    // One-metre grid (five in wide pictures), in pieces of two that fade with their distance;
    // pieces of like strength are stroked together.
    const step = distance > 14 ? 5 : 1, reach = 14, levels = 6;
    const x0 = step * Math.round(target[0] / step), y0 = step * Math.round(target[1] / step);
    const bins = Array.from({ length: levels }, () => []);
    for (let i = -reach; i <= reach; i++)
      for (let k = -reach; k < reach; k += 2) {
        const level = Math.floor((1 - Math.hypot(i, k + 1) / reach) * levels);
        if (level < 0) continue;
        const a = step * i, b = step * k, c = step * (k + 2);
        bins[level].push(
          [[x0 + a, y0 + b, 0], [x0 + a, y0 + c, 0]], [[x0 + b, y0 + a, 0], [x0 + c, y0 + a, 0]]);
      }
    ctx.strokeStyle = theme.grid;
    ctx.lineWidth = 1;
    bins.forEach((bin, level) => {
      ctx.globalAlpha = ((level + 1) / levels) ** 1.5;
      ctx.beginPath();
      for (const ends of bin) {
        const line = clipped(cam, ends);
        if (line.length > 1) trace(ctx, line);
      }
      ctx.stroke();
    });
    ctx.globalAlpha = 1;
  }

  // Names of the marks beside their edge nearest to the camera, as far as there is room.
  function drawLabels(ctx, cam, scene, theme, distance) {
    ctx.font = "12px system-ui, sans-serif";
    ctx.textAlign = "center";
    ctx.fillStyle = theme.label;
    const near = Math.sign(cam.right[0] || 1), taken = [];
    for (const mark of scene.marks) {
      if (!mark.label) continue;
      const xs = mark.corners.map((c) => c[0]), ys = mark.corners.map((c) => near * c[1]);
      const x = (Math.min(...xs) + Math.max(...xs)) / 2, y = near * (Math.min(...ys) - 0.2);
      const p = cam.project([x, y, 0]);
      if (p[2] < 1 || p[2] > Math.max(25, 2 * distance) || taken.some((q) => Math.hypot(p[0] - q[0], 2 * (p[1] - q[1])) < 44)) continue;
      taken.push(p);
      ctx.fillText(mark.label, p[0], p[1] + 4);
    }
  }

  function drawArrow(ctx, from, to, color) {
    const dx = to[0] - from[0], dy = to[1] - from[1], n = Math.hypot(dx, dy);
    if (n < 3) return;
    const ux = dx / n, uy = dy / n, head = Math.min(9, n);
    ctx.strokeStyle = ctx.fillStyle = color;
    ctx.lineWidth = 2.5;
    ctx.beginPath();
    ctx.moveTo(from[0], from[1]);
    ctx.lineTo(to[0] - ux * head * 0.7, to[1] - uy * head * 0.7);
    ctx.stroke();
    ctx.beginPath();
    ctx.moveTo(to[0], to[1]);
    ctx.lineTo(to[0] - ux * head - uy * head * 0.45, to[1] - uy * head + ux * head * 0.45);
    ctx.lineTo(to[0] - ux * head + uy * head * 0.45, to[1] - uy * head - ux * head * 0.45);
    ctx.fill();
  }

  function drawView(ctx, state, tracks, all, t, width, height, theme) {
    const { scene, view } = state;
    const target = view.follow
      ? S.add(tracks[0].focus(t), view.pan)
      : S.add(view.fixed, view.pan);
    const cam = camera(view, target, width, height);
    const sky = ctx.createLinearGradient(0, 0, 0, height);
    sky.addColorStop(0, theme.skyHigh);
    sky.addColorStop(0.5, theme.skyLow);
    sky.addColorStop(1, theme.ground);
    ctx.fillStyle = sky;
    ctx.fillRect(0, 0, width, height);
    drawGround(ctx, cam, scene, target, theme, view.distance);

    const items = [];
    ctx.fillStyle = theme.shadow;
    ctx.beginPath();
    for (const [i, track] of tracks.entries()) {
      const solids = track.solids(t, all.length === 1 || track === all[0], i ? tracks[0] : null);
      track.poses = solids.poses;
      for (const [part, color] of solids.out) {
        const lowest = Math.min(...points(part).map((p) => cam.depth(p)));
        if (lowest < NEAR) continue;
        items.push([S.norm(S.sub(center(part), cam.eye)) - (part.over || 0), part, color]);
        if (part.net) continue;
        const cast = clipped(cam, shadow(part));
        if (cast.length > 2) {
          trace(ctx, cast);
          ctx.closePath();
        }
      }
    }
    ctx.fill("nonzero");

    if (state.trails)
      for (const track of tracks)
        for (const at of scene.trails) {
          ctx.strokeStyle = at === scene.subject.at && scene.subject.name ? theme.force : track.color;
          ctx.globalAlpha = 0.55;
          ctx.lineWidth = 1.5;
          ctx.setLineDash([2, 5]);
          ctx.beginPath();
          let pen = false, last = null;
          for (const q of track.qpos) {
            const place = [q[at], q[at + 1], q[at + 2]], p = cam.project(place);
            // What was put elsewhere did not fly there.
            if (last && S.norm(S.sub(place, last)) > 2) pen = false;
            if (p[2] > NEAR) pen ? ctx.lineTo(p[0], p[1]) : ctx.moveTo(p[0], p[1]);
            pen = p[2] > NEAR;
            last = place;
          }
          ctx.stroke();
          ctx.setLineDash([]);
          ctx.globalAlpha = 1;
        }

    items.sort((a, b) => b[0] - a[0]);
    for (const [, part, color] of items) {
      ctx.globalAlpha = part.net ? 1 : part.alpha || 1;
      DRAW[part.kind](ctx, cam, part, color);
    }
    ctx.globalAlpha = 1;

    if (state.forces)
      for (const track of tracks)
        for (const { link, f } of track.forces(t)) {
          const p = track.poses[link].p, foot = [p[0], p[1], 0.02];
          const tip = S.add(foot, S.scale(f, 0.0006));
          if (cam.depth(foot) > NEAR && cam.depth(tip) > NEAR)
            drawArrow(ctx, cam.project(foot), cam.project(tip), theme.force);
        }
  }

  return { view: drawView, parse };
})();
