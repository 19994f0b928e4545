// Replay, part 3: the motions and the controls around the picture.
"use strict";

const Replay = (() => {
  const S = ReplayScene, parse = ReplayDraw.parse;

  // ---- a scene ----------------------------------------------------------------------------
  class Track {
    constructor(scene, data) {
      this.scene = scene;
      this.name = data.name;
      this.start = data.start;
      this.dt = data.dt;
      this.color = data.color;
      this.visible = true;
      this.qpos = S.unpack(data.qpos);
      this.mocap = data.mocap ? S.unpack(data.mocap) : null;
      this.force = data.force ? S.unpack(data.force) : null;
      this.distance = data.distance || 0; // from which the camera sees everybody
      this.end = this.start + this.dt * (this.qpos.length - 1);
      // Where the camera looks: what the page says, or the root, averaged over half a second.
      this.aim = data.focus ? S.unpack(data.focus) : null;
      const reach = Math.max(1, Math.round(0.25 / this.dt)), last = this.qpos.length - 1;
      this.path = this.qpos.map((_, i) => {
        let sum = [0, 0, 0];
        for (let k = -reach; k <= reach; k++)
          sum = S.add(sum, this.qpos[Math.min(Math.max(i + k, 0), last)]);
        return Float64Array.from(S.scale(sum, 1 / (2 * reach + 1)));
      });
    }
    state(t) {
      return S.at(this.qpos, this.dt, t - this.start);
    }
    focus(t) {
      if (this.aim) return Array.from(S.at(this.aim, this.dt, t - this.start));
      const p = S.at(this.path, this.dt, t - this.start);
      return [p[0], p[1], 0.8 * p[2] + 0.12];
    }
    forces(t) {
      if (!this.force) return [];
      const i = Math.round((t - this.start) / this.dt);
      const row = this.force[Math.min(Math.max(i, 0), this.force.length - 1)], out = [];
      for (let k = 0; k < row.length; k += 3) {
        const f = [row[k], row[k + 1], row[k + 2]];
        if (S.norm(f) > 20) out.push({ link: k / 3, f });
      }
      return out;
    }
    speed(t) {
      const i = Math.min(Math.max((t - this.start) / this.dt, 0.5), this.qpos.length - 1.5);
      const k = this.scene.subject.at;
      const at = (j) => S.at(this.qpos, this.dt, j * this.dt).slice(k, k + 3);
      return S.norm(S.sub(at(i + 0.5), at(i - 0.5))) / this.dt;
    }
    // Parts to draw, each with its colour; and the athletes' link poses.
    solids(t, own, lead) {  // lead: the first track shown, or null if this is it
      const { scene } = this, qpos = this.state(t), out = [], poses = [];
      const width = 7 + 3 * (scene.links.length - 1), tint = own ? null : parse(this.color);
      for (let a = 0; a < scene.agents; a++) {
        const links = S.linkPoses(scene.links, qpos, a * width);
        poses.push(...links);
        links.forEach((pose, i) => {
          for (const part of scene.links[i].parts)
            out.push([S.place(part, pose), tint || parse(scene.colors[a][i][part.shape])]);
        });
      }
      const mocap = this.mocap ? S.at(this.mocap, this.dt, t - this.start) : [];
      this.objects = S.objectPoses(scene, qpos, mocap);
      this.objects.forEach((pose, i) => {
        // What stands where the leading track has it is drawn once.
        if (lead && S.norm(S.sub(pose.p, lead.objects[i].p)) < 0.02) return;
        const o = scene.objects[i], color = tint && lead ? tint : parse(o.color);
        for (const part of o.parts) out.push([S.place(part, pose), color]);
      });
      return { out, poses };
    }
  }

  // ---- the player -------------------------------------------------------------------------
  function mount(root, data) {
    const $ = (name) => root.querySelector(`[data-replay="${name}"]`);
    const canvas = $("canvas"), ctx = canvas.getContext("2d");
    const scene = data.scene;
    for (const thing of [...scene.links, ...scene.objects]) {
      const { alpha, net, over } = thing;
      thing.parts = thing.shapes.flatMap((shape, k) =>
        S.parts(shape).map((part) => ({ ...part, shape: k, alpha, net, over })));
    }
    const tracks = data.tracks.map((track) => new Track(scene, track));
    const t0 = Math.min(...tracks.map((k) => k.start)), t1 = Math.max(...tracks.map((k) => k.end));
    const far = Math.max(5.4, ...tracks.map((k) => k.distance));
    const home = () => ({
      yaw: data.yaw, pitch: data.pitch, distance: far, follow: true, pan: [0, 0, 0], fixed: [0, 0, 0],
    });
    const state = { scene, view: home(), trails: true, forces: false, split: false };
    let t = Math.min(Math.max(data.poster, t0), t1), playing = false, speed = 1, queued = false;
    let before = 0, theme = {};

    function readTheme() {
      const style = getComputedStyle(root);
      for (const name of ["skyHigh", "skyLow", "ground", "grid", "shadow", "label", "force", "paint"])
        theme[name] = style.getPropertyValue(`--replay-${name.toLowerCase()}`).trim();
      theme.paint = Number(theme.paint) || 1;
    }

    function draw() {
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      const width = canvas.clientWidth, height = canvas.clientHeight;
      if (!width) return;
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
        canvas.width = Math.round(width * ratio);
        canvas.height = Math.round(height * ratio);
      }
      ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
      const shown = tracks.filter((k) => k.visible);
      const groups = state.split && shown.length > 1 ? shown.map((k) => [k]) : [shown.length ? shown : [tracks[0]]];
      const w = width / groups.length;
      groups.forEach((group, i) => {
        ctx.save();
        ctx.translate(i * w, 0);
        ctx.beginPath();
        ctx.rect(0, 0, w, height);
        ctx.clip();
        ReplayDraw.view(ctx, state, group, groups.length > 1 ? group : tracks, t, w, height, theme);
        if (groups.length > 1) {
          ctx.fillStyle = theme.label;
          ctx.font = "600 13px system-ui, sans-serif";
          ctx.textAlign = "left";
          ctx.fillText(group[0].name, 12, 22);
          if (i) ctx.fillRect(0, 0, 1, height);
        }
        ctx.restore();
      });
      const lead = shown[0] || tracks[0], k = scene.subject.at, q = lead.state(t).slice(k, k + 3);
      const name = scene.subject.name && `${scene.subject.name}   `;
      $("time").textContent = `${t.toFixed(2)} s`;
      $("facts").textContent =
        `${name}x ${q[0].toFixed(2)} m   height ${q[2].toFixed(2)} m   speed ${lead.speed(t).toFixed(1)} m/s`;
      $("scrub").value = String(t);
      $("scrub").setAttribute("aria-valuetext", `${t.toFixed(2)} seconds`);
    }

    function tick(now) {
      queued = false;
      if (playing) {
        t += ((now - before) / 1000) * speed;
        before = now;
        if (t > t1) t = t0 + ((t - t0) % Math.max(t1 - t0, 1e-3));
      }
      draw();
      if (playing) request();
    }
    function request() {
      if (!queued) requestAnimationFrame(tick);
      queued = true;
    }
    function play(on) {
      playing = on;
      before = performance.now();
      $("play").textContent = on ? "❚❚" : "▶";
      $("play").setAttribute("aria-label", on ? "Pause" : "Play");
      request();
    }
    function seek(value) {
      t = Math.min(Math.max(value, t0), t1);
      request();
    }
    function follow(on) {
      if (!on && state.view.follow) state.view.fixed = (tracks.find((k) => k.visible) || tracks[0]).focus(t);
      state.view.follow = on;
      $("follow").checked = on;
      request();
    }
    function zoom(factor) {
      state.view.distance = Math.min(Math.max(state.view.distance * factor, 1.5), 120);
      request();
    }
    function orbit(dx, dy) {
      state.view.yaw -= dx;
      state.view.pitch = Math.min(Math.max(state.view.pitch + dy, -0.02), 1.55);
      request();
    }
    function pan(dx, dy) {
      const c = Math.cos(state.view.yaw), s = Math.sin(state.view.yaw), k = state.view.distance / 500;
      state.view.pan = S.add(state.view.pan, [-s * dx * k, c * dx * k, dy * k]);
      request();
    }
    function look(name) {
      const view = { start: [data.yaw, data.pitch], side: [data.heading + Math.PI / 2, 0.06],
        front: [data.heading + Math.PI, 0.1], behind: [data.heading, 0.22], top: [data.heading + Math.PI / 2, 1.5] }[name];
      if (!view) return;
      [state.view.yaw, state.view.pitch] = view;
      state.view.pan = [0, 0, 0];
      if (name === "start") state.view = { ...home(), follow: state.view.follow, fixed: state.view.fixed };
      request();
    }

    // Pointer: one finger or button turns, two fingers zoom and shift, shift or right button shifts.
    const held = new Map();
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      held.set(e.pointerId, [e.clientX, e.clientY]);
    });
    canvas.addEventListener("pointermove", (e) => {
      const last = held.get(e.pointerId);
      if (!last) return;
      const dx = e.clientX - last[0], dy = e.clientY - last[1];
      if (held.size === 2) {
        const other = [...held].find(([id]) => id !== e.pointerId)[1];
        const gap = (x, y) => Math.hypot(x - other[0], y - other[1]) || 1;
        zoom(gap(...last) / gap(e.clientX, e.clientY));
        pan(dx / 2, dy / 2);
      } else if (e.shiftKey || e.buttons & 2) pan(dx, dy);
      else orbit(dx * 0.008, dy * 0.006);
      held.set(e.pointerId, [e.clientX, e.clientY]);
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, (e) => held.delete(e.pointerId));
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => {
      // The page scrolls on until the replay has been clicked.
      if (!root.contains(document.activeElement) && !e.ctrlKey) return;
      e.preventDefault();
      zoom(Math.exp(Math.sign(e.deltaY) * 0.1));
    }, { passive: false });
    canvas.addEventListener("pointerdown", () => root.focus({ preventScroll: true }));

    $("play").addEventListener("click", () => play(!playing));
    $("scrub").min = String(t0);
    $("scrub").max = String(t1);
    $("scrub").addEventListener("input", (e) => { play(false); seek(Number(e.target.value)); });
    $("speed").addEventListener("change", (e) => { speed = Number(e.target.value); });
    $("follow").addEventListener("change", (e) => follow(e.target.checked));
    $("look").addEventListener("change", (e) => look(e.target.value));
    $("trails").addEventListener("change", (e) => { state.trails = e.target.checked; request(); });
    $("forces").closest("label").hidden = !tracks.some((k) => k.force);
    $("forces").addEventListener("change", (e) => { state.forces = e.target.checked; request(); });
    $("split").closest("label").hidden = tracks.length < 2;
    $("split").addEventListener("change", (e) => { state.split = e.target.checked; request(); });
    const legend = $("legend");
    legend.hidden = tracks.length < 2;
    tracks.forEach((track, i) => {
      const label = document.createElement("label"), box = document.createElement("input");
      const dot = document.createElement("span");
      box.type = "checkbox";
      box.checked = true;
      box.addEventListener("change", () => { track.visible = box.checked; request(); });
      dot.className = i ? "dot" : "dot limbs";
      dot.style.setProperty("--dot", track.color);
      label.append(box, dot, track.name);
      legend.append(label);
    });

    root.addEventListener("keydown", (e) => {
      if (e.target.tagName === "SELECT" || e.ctrlKey || e.metaKey || e.altKey) return;
      if (e.target.tagName === "INPUT" && (e.key === " " || e.key.startsWith("Arrow"))) return;
      if (e.target.tagName === "BUTTON" && e.key === " ") return;
      const step = tracks[0].dt, turn = 0.12;
      const keys = {
        " ": () => play(!playing),
        ArrowLeft: () => (e.shiftKey ? orbit(turn, 0) : (play(false), seek(t - step))),
        ArrowRight: () => (e.shiftKey ? orbit(-turn, 0) : (play(false), seek(t + step))),
        ArrowUp: () => orbit(0, turn / 2),
        ArrowDown: () => orbit(0, -turn / 2),
        Home: () => seek(t0),
        End: () => seek(t1),
        "+": () => zoom(0.9),
        "=": () => zoom(0.9),
        "-": () => zoom(1.1),
        f: () => follow(!state.view.follow),
      };
      if (!keys[e.key]) return;
      e.preventDefault();
      keys[e.key]();
    });

    readTheme();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readTheme(); request(); });
    if (window.ResizeObserver) new ResizeObserver(request).observe(canvas);
    draw();
    return { seek, play, look, zoom, orbit, tracks, state, draw };
  }

  return { mount };
})();
