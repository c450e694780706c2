// SPDX-License-Identifier: Apache-2.0
// The aircraft in 3D from two viewpoints: one world, drawn twice.
//
// World: metres, x east, y north, z up; its origin is home, or the first reported position.
// Aircraft models have x forward, y left, z up.
import { THREE } from "nicegui-scene";

const EARTH_M = 6378137;
const TAIL = 6000; // points of a path
const STEP_M = 1.5; // between them
const GAP_M = 1e9; // farther than any point
const AHEAD_S = 0.25; // poses are extrapolated no further
const FRAME_MS = 30;
const SLOWEST_MS = 400;
const LATE_MS = 45; // interval of the browser's frames above which drawing is too slow
const VIEWS = { chase: "Chase", ground: "From the ground", cockpit: "Cockpit", above: "From above", side: "From the side" };
const SPAN_M = 2; // wing span of the models
const STRONG_US = 90e6; // the path of this time before the shown state is highlighted
const FAINT = 0.2; // factor for the opacity of the rest, which would hide the aircraft
const LEAST_HEIGHT_M = 0.3;
const HEIGHT_ERROR_M = 5;
const COLOURS = { recorded: "recorded", "fused again": "fused-again" };
const rad = Math.PI / 180;

// Whether the processor draws without a GPU; it also draws the other widgets and may run a gateway.
function in_software() {
  const gl = document.createElement("canvas").getContext("webgl");
  const extension = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = extension ? gl.getParameter(extension.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

function material(colour, extra = {}) {
  return new THREE.MeshStandardMaterial({ color: colour, roughness: 0.55, metalness: 0.05, ...extra });
}

function box(group, size, at, colour) {
  const mesh = new THREE.Mesh(new THREE.BoxGeometry(...size), material(colour));
  mesh.position.set(...at);
  group.add(mesh);
  return mesh;
}

// A thin, tapered, swept surface between two chords.
function surface(group, root, tip, colour) {
  const thick = 0.018;
  const [rx, ry, rz, rc] = root;
  const [tx, ty, tz, tc] = tip;
  const corners = [];
  for (const z of [thick, -thick])
    corners.push([rx, ry, rz + z], [rx - rc, ry, rz + z], [tx - tc, ty, tz + z], [tx, ty, tz + z]);
  const faces = [0, 1, 2, 0, 2, 3, 6, 5, 4, 7, 6, 4, 3, 2, 6, 3, 6, 7, 0, 4, 5, 0, 5, 1, 0, 3, 7, 0, 7, 4];
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(corners.flat(), 3));
  geometry.setIndex(faces);
  const flat = geometry.toNonIndexed();
  flat.computeVertexNormals();
  group.add(new THREE.Mesh(flat, material(colour, { side: THREE.DoubleSide })));
}

function plane(main, trim) {
  const group = new THREE.Group();
  const profile = [[0, 0.72], [0.05, 0.7], [0.1, 0.55], [0.11, 0.2], [0.1, -0.1], [0.05, -0.45], [0.028, -0.86], [0, -0.88]];
  const body = new THREE.Mesh(
    new THREE.LatheGeometry(profile.map(([r, x]) => new THREE.Vector2(r, x)), 18),
    material(main),
  );
  body.rotation.z = -Math.PI / 2;
  group.add(body);
  const canopy = new THREE.Mesh(new THREE.SphereGeometry(0.1, 16, 10), material("#1b2b3a", { roughness: 0.2 }));
  canopy.scale.set(2.1, 0.75, 0.75);
  canopy.position.set(0.28, 0, 0.075);
  group.add(canopy);
  for (const side of [1, -1]) {
    surface(group, [0.26, 0.06 * side, 0.03, 0.34], [0.16, 0.86 * side, 0.09, 0.2], main);
    surface(group, [0.16, 0.86 * side, 0.09, 0.2], [0.13, 1.0 * side, 0.105, 0.15], trim);
    surface(group, [-0.6, 0.03 * side, 0.02, 0.2], [-0.68, 0.36 * side, 0.03, 0.12], trim);
  }
  const fin = new THREE.Group();
  surface(fin, [0, 0, 0, 0.24], [-0.14, 0.32, 0, 0.12], trim);
  fin.rotation.x = Math.PI / 2;
  fin.position.set(-0.58, 0, 0.02);
  group.add(fin);
  const disc = new THREE.Mesh(
    new THREE.CircleGeometry(0.24, 32),
    material("#9fb3c4", { transparent: true, opacity: 0.28, side: THREE.DoubleSide }),
  );
  disc.rotation.y = Math.PI / 2;
  disc.position.x = 0.74;
  group.add(disc);
  return group;
}

function copter(main, trim) {
  const group = new THREE.Group();
  const body = new THREE.Mesh(new THREE.SphereGeometry(0.22, 20, 12), material(main));
  body.scale.set(1.5, 0.95, 0.5);
  group.add(body);
  box(group, [0.12, 0.1, 0.06], [0.32, 0, 0.0], "#1b2b3a");
  for (const [x, y] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
    const arm = box(group, [0.86, 0.06, 0.05], [x * 0.3, y * 0.3, 0.02], main);
    arm.rotation.z = Math.atan2(y, x);
    const motor = new THREE.Mesh(new THREE.CylinderGeometry(0.06, 0.07, 0.12, 16), material("#33414e"));
    motor.rotation.x = Math.PI / 2;
    motor.position.set(x * 0.6, y * 0.6, 0.07);
    group.add(motor);
    const rotor = new THREE.Mesh(
      new THREE.CircleGeometry(0.34, 32),
      material(x > 0 ? trim : "#9fb3c4", { transparent: true, opacity: 0.4, side: THREE.DoubleSide }),
    );
    rotor.position.set(x * 0.6, y * 0.6, 0.14);
    group.add(rotor);
    box(group, [0.03, 0.03, 0.22], [x * 0.18, y * 0.2, -0.18], "#33414e");
  }
  return group;
}

function dart(main) {
  const group = new THREE.Group();
  const cone = new THREE.Mesh(new THREE.ConeGeometry(0.3, 1.3, 4), material(main, { flatShading: true }));
  cone.rotation.z = -Math.PI / 2;
  group.add(cone);
  return group;
}

const MODELS = { plane, copter, heli: copter };

// A line several pixels wide, unlike WebGL's own lines: a flat strip that faces the camera.
const LINE_SHADER = `
  uniform vec2 resolution;
  uniform float width;
  uniform vec2 strong;
  attribute vec3 begin;
  attribute vec3 end;
  varying float side;
  varying float strength;
  void main() {
    side = position.y;
    if (max(begin.x, end.x) >= GAP) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
    float number = float(gl_InstanceID);
    strength = number >= strong.x && number < strong.y ? 1.0 : FAINT;
    vec4 from = projectionMatrix * modelViewMatrix * vec4(begin, 1.0);
    vec4 to = projectionMatrix * modelViewMatrix * vec4(end, 1.0);
    // The part behind the camera is cut off at the near plane, where w is small but positive.
    float near = 0.05;
    if (from.w < near && to.w < near) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
    if (from.w < near) from = mix(from, to, (near - from.w) / (to.w - from.w));
    if (to.w < near) to = mix(to, from, (near - to.w) / (from.w - to.w));
    vec2 along = (to.xy / to.w - from.xy / from.w) * resolution;
    float size = length(along);
    along = size > 1e-4 ? along / size : vec2(1.0, 0.0);
    vec4 corner = position.x < 0.5 ? from : to;
    vec2 away = vec2(-along.y, along.x) * position.y + along * (position.x - 0.5) * 0.8;
    corner.xy += away * width / resolution * corner.w;
    gl_Position = corner;
  }`;

// Soft edges, even if the processor draws without antialiasing.
const LINE_COLOUR = `
  uniform vec3 colour;
  uniform float opacity;
  varying float side;
  varying float strength;
  void main() {
    gl_FragColor = vec4(colour, opacity * strength * (1.0 - smoothstep(0.45, 1.0, abs(side))));
    #include <colorspace_fragment>
  }`;

class WideLine {
  constructor(colour, width, opacity) {
    this.positions = new Float32Array(TAIL * 3);
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute([0, -1, 0, 1, -1, 0, 1, 1, 0, 0, 1, 0], 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    this.buffer = new THREE.InstancedInterleavedBuffer(this.positions, 3, 1);
    geometry.setAttribute("begin", new THREE.InterleavedBufferAttribute(this.buffer, 3, 0));
    // The same array, offset by one point.
    this.later = new THREE.InstancedInterleavedBuffer(this.positions.subarray(3), 3, 1);
    geometry.setAttribute("end", new THREE.InterleavedBufferAttribute(this.later, 3, 0));
    this.material = new THREE.ShaderMaterial({
      vertexShader: LINE_SHADER,
      defines: { FAINT, GAP: GAP_M.toExponential() },
      fragmentShader: LINE_COLOUR,
      uniforms: { resolution: { value: new THREE.Vector2(1, 1) }, width: { value: width }, colour: { value: new THREE.Color(colour) }, opacity: { value: opacity }, strong: { value: new THREE.Vector2(0, TAIL) } },
      transparent: true, depthWrite: false, side: THREE.DoubleSide,
    });
    this.mesh = new THREE.Mesh(geometry, this.material);
    this.mesh.frustumCulled = false;
    this.show(0);
  }
  show(count) {
    this.mesh.geometry.instanceCount = Math.max(0, count - 1);
    this.mesh.visible = count > 1;
    this.buffer.needsUpdate = this.later.needsUpdate = true;
  }
}

// Lines from and to this point are not drawn.
const GAP = { x: GAP_M, y: GAP_M, z: GAP_M };

class Path {
  constructor(scene, colour) {
    this.count = 0;
    this.version = -1;
    this.read = 0;
    this.time_us = new Float64Array(TAIL);
    this.line = new WideLine(colour, 3, 1);
    this.shadow = new WideLine("#000000", 2.4, 0.25);
    this.stalk = new WideLine(colour, 2, 0.6);
    this.lines = [this.line, this.shadow, this.stalk];
    for (const part of this.parts()) scene.add(part);
  }
  parts() {
    return this.lines.map((line) => line.mesh);
  }
  resize(width, height) {
    for (const line of this.lines) line.material.uniforms.resolution.value.set(width, height);
  }
  // Update the drawn path from that of the telemetry, and to the shown time.
  update(track, place, now_us) {
    this.extend(track, place);
    const [from, to] = [now_us - STRONG_US, now_us].map((time_us) => this.row_at(time_us));
    for (const line of [this.line, this.shadow]) line.material.uniforms.strong.value.set(from, to);
  }
  // The first row that is not before a time.
  row_at(time_us) {
    let [low, high] = [0, this.count];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time_us[middle] < time_us) low = middle + 1;
      else high = middle;
    }
    return low;
  }
  extend(track, place) {
    if (this.version !== track.version) {
      this.version = track.version;
      this.count = 0;
      this.read = Math.max(0, track.points.length - TAIL / 2);
    }
    if (this.read === track.points.length) return;
    for (; this.read < track.points.length; this.read++) {
      const point = track.points[this.read];
      // A recorded path has the gaps of the recording.
      if (this.count && track.breaks?.has(this.read)) this.add(GAP, point[3]);
      this.add(place(...point), point[3]);
    }
    for (const line of [this.line, this.shadow]) line.show(this.count);
  }
  add(point, time_us) {
    const at = this.line.positions;
    if (this.count) {
      const [x, y, z] = at.subarray((this.count - 1) * 3, this.count * 3);
      if (Math.hypot(point.x - x, point.y - y, point.z - z) < STEP_M) return;
    }
    if (this.count === TAIL) {
      // The older half is dropped at once, so that the rest is seldom moved.
      for (const line of [this.line, this.shadow]) line.positions.copyWithin(0, (TAIL / 2) * 3);
      this.time_us.copyWithin(0, TAIL / 2);
      this.count = TAIL / 2;
    }
    at.set([point.x, point.y, point.z], this.count * 3);
    this.time_us[this.count] = time_us;
    this.shadow.positions.set([point.x, point.y, 0.02], this.count * 3);
    this.count += 1;
  }
  end(point) {
    this.stalk.positions.set([point.x, point.y, point.z, point.x, point.y, 0]);
    this.stalk.show(2);
  }
}

// The height above home at which an object is drawn. The error of a height near the ground must not
// hide an aircraft in it; an airfield that really is below home is seen through the ground.
function drawn_height(height) {
  if (height >= LEAST_HEIGHT_M) return height;
  return height > -HEIGHT_ERROR_M ? LEAST_HEIGHT_M : height + HEIGHT_ERROR_M + LEAST_HEIGHT_M;
}

export default {
  template: `
    <div class="scene" tabindex="0" aria-label="Aircraft in 3D">
      <canvas></canvas>
      <div v-for="(view, i) in views" :key="i" class="scene-view" :data-place="i">
        <select class="scene-choice" v-model="views[i]" :aria-label="'Viewpoint ' + (i + 1)">
          <option v-for="(title, key) in titles" :key="key" :value="key">{{ title }}</option>
        </select>
        <span class="scene-note">{{ notes[i] }}</span>
      </div>
      <div v-if="trouble" class="scene-trouble">{{ trouble }}</div>
    </div>`,
  data: () => ({ views: ["chase", "ground"], titles: VIEWS, notes: ["", ""], trouble: "" }),

  mounted() {
    this.canvas = this.$el.querySelector("canvas");
    try {
      this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: !in_software() });
    } catch {
      this.trouble = "This browser cannot show 3D (WebGL is off).";
      return;
    }
    this.renderer.setPixelRatio(in_software() ? 0.75 : Math.min(window.devicePixelRatio, 1.5));
    this.renderer.setScissorTest(true);
    this.aircraft = {};
    this.origin = null;
    this.drawn_ms = this.asked_ms = 0;
    this.pace_ms = FRAME_MS;
    this.swing = { azimuth: 0, elevation: 14, distance: 6.5 };
    this.build_world();
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(this.$el);
    this.stop = mavgate.subscribe(() => this.take());
    this.stop_theme = mavgate.watch_theme(() => this.paint());
    this.$el.addEventListener("pointermove", (event) => this.drag(event));
    this.$el.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.resize();
    const draw = (now_ms) => {
      this.handle = requestAnimationFrame(draw);
      // If drawing in software is too slow, the 3D view is drawn less often than the other widgets.
      const late = now_ms - this.asked_ms > LATE_MS;
      this.asked_ms = now_ms;
      this.pace_ms = Math.min(SLOWEST_MS, Math.max(FRAME_MS, this.pace_ms * (late ? 1.25 : 0.97)));
      if (now_ms - this.drawn_ms < this.pace_ms || !this.$el.offsetParent) return;
      this.drawn_ms = now_ms;
      this.draw();
    };
    draw(0);
  },
  unmounted() {
    cancelAnimationFrame(this.handle);
    this.stop?.();
    this.observer?.disconnect();
    this.stop_theme?.();
    this.renderer?.dispose();
  },

  methods: {
    build_world() {
      this.scene = new THREE.Scene();
      this.sun = new THREE.DirectionalLight("#ffffff", 2.2);
      this.sun.position.set(-60, -40, 90);
      this.fill = new THREE.HemisphereLight("#ffffff", "#88775f", 1.6);
      this.scene.add(this.sun, this.fill);
      this.ground = new THREE.Mesh(new THREE.CircleGeometry(8000, 48), new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.72, depthWrite: false, side: THREE.DoubleSide }));
      this.ground.position.z = -0.3;
      this.ground.renderOrder = -1;
      this.fine = new THREE.GridHelper(1000, 100);
      this.coarse = new THREE.GridHelper(16000, 160);
      this.coarse.position.z = -0.15;
      for (const grid of [this.fine, this.coarse]) {
        grid.rotation.x = Math.PI / 2;
        grid.material.transparent = true;
        this.scene.add(grid);
      }
      const home = (this.home = new THREE.Group());
      this.pad = new THREE.Mesh(new THREE.RingGeometry(0.55, 0.75, 40), new THREE.MeshBasicMaterial({ side: THREE.DoubleSide }));
      this.pole = new THREE.Mesh(new THREE.CylinderGeometry(0.03, 0.03, 1.5, 8), new THREE.MeshBasicMaterial());
      this.pole.rotation.x = Math.PI / 2;
      this.pole.position.z = 0.75;
      home.add(this.pad, this.pole);
      this.beacon = new THREE.Mesh(new THREE.CylinderGeometry(0.5, 0.5, 60, 10), new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.55 }));
      this.beacon.rotation.x = Math.PI / 2;
      this.beacon.visible = false;
      this.scene.add(this.ground, home, this.beacon);
      this.cameras = [0, 1].map(() => {
        const camera = new THREE.PerspectiveCamera(55, 1, 0.1, 12000);
        camera.up.set(0, 0, 1);
        return camera;
      });
      this.paint();
    },
    paint() {
      const sky = mavgate.colour("sky-far");
      this.scene.background = new THREE.Color(sky);
      this.scene.fog = new THREE.Fog(sky, 150, 2600);
      this.ground.material.color.set(mavgate.colour("terrain"));
      for (const [grid, opacity] of [[this.fine, 0.28], [this.coarse, 0.5]]) {
        grid.material.color.set(mavgate.colour("terrain-line"));
        grid.material.vertexColors = false;
        grid.material.opacity = opacity;
        grid.material.needsUpdate = true;
      }
      this.pad.material.color.set(mavgate.colour("home"));
      this.pole.material.color.set(mavgate.colour("home"));
      this.beacon.material.color.set(mavgate.colour("mark"));
      for (const id of Object.keys(this.aircraft)) this.discard(id);
      this.take();
    },
    place(lat, lon, alt) {
      const o = this.origin;
      const cos = Math.cos(o.lat * rad);
      let east = lon - o.lon;
      if (east > 180) east -= 360;
      if (east < -180) east += 360;
      return new THREE.Vector3(east * rad * cos * EARTH_M, (lat - o.lat) * rad * EARTH_M, drawn_height(alt - o.alt));
    },
    take() {
      const now_ms = performance.now();
      for (const id of Object.keys(mavgate.vehicles)) {
        const state = mavgate.shown(id);
        if (!state || state.lat_deg === null || state.alt_amsl_m === null) continue;
        this.set_origin(state);
        const known = this.aircraft[id];
        if (known && known.model !== state.model) this.discard(id);
        const craft = (this.aircraft[id] ??= this.make(id, state));
        const point = this.place(state.lat_deg, state.lon_deg, state.alt_amsl_m);
        if (!craft.point || craft.point.distanceToSquared(point) > 0) {
          craft.point = point;
          craft.moved_ms = now_ms;
        }
        craft.path.update(mavgate.track(id), (...spot) => this.place(...spot), mavgate.past_us ?? mavgate.now_us);
        craft.state = state;
        craft.turned_ms = now_ms;
      }
      for (const id of Object.keys(this.aircraft)) if (!(id in mavgate.vehicles)) this.discard(id);
      // Before the first position there is no ground.
      this.fine.visible = this.coarse.visible = Boolean(this.origin);
      const mark = mavgate.state?.mark;
      this.beacon.visible = Boolean(mark && this.origin);
      if (this.beacon.visible) this.beacon.position.copy(this.place(mark.lat_deg, mark.lon_deg, this.origin.alt + 30));
    },
    set_origin(state) {
      const home = state.home;
      const here = home ?? state;
      const wanted = { lat: here.lat_deg, lon: here.lon_deg, alt: here.alt_amsl_m, by_home: Boolean(home) };
      const moved = this.origin && Math.hypot(wanted.lat - this.origin.lat, wanted.lon - this.origin.lon) > 1e-4;
      if (!this.origin || (wanted.by_home && !this.origin.by_home) || (moved && wanted.by_home && this.owner === state.system_id)) {
        this.origin = wanted;
        this.owner = state.system_id;
        for (const id of Object.keys(this.aircraft)) this.discard(id);
      }
    },
    make(id, { model, origin }) {
      const main = mavgate.colour(id === mavgate.selected ? "craft" : "craft-other");
      const group = (MODELS[model] ?? dart)(main, mavgate.colour("craft-trim"));
      group.userData.yardstick = SPAN_M;
      this.scene.add(group);
      const craft = { group, model, path: new Path(this.scene, mavgate.colour(COLOURS[origin] ?? "track")), state: null, point: null };
      craft.pose = new THREE.Quaternion();
      return craft;
    },
    discard(id) {
      const craft = this.aircraft[id];
      if (!craft) return;
      this.scene.remove(craft.group, ...craft.path.parts());
      delete this.aircraft[id];
    },
    pose(craft, now_ms) {
      const { state, group } = craft;
      const turned_s = Math.min((now_ms - craft.turned_ms) / 1000, AHEAD_S);
      const moved_s = Math.min((now_ms - craft.moved_ms) / 1000, AHEAD_S);
      if (state.q_nb[0] !== null) {
        const [w, x, y, z] = state.q_nb;
        const q_nb = new THREE.Quaternion(x, y, z, w);
        const [p, q, r] = state.rate_b_radps.map((rate) => (rate ?? 0) * turned_s);
        const angle = Math.hypot(p, q, r);
        if (angle > 1e-6) q_nb.multiply(new THREE.Quaternion().setFromAxisAngle(new THREE.Vector3(p, q, r).normalize(), angle));
        // Converts FRD to NED into x forward, y left, z up to east, north, up.
        const to_enu = new THREE.Quaternion(Math.SQRT1_2, Math.SQRT1_2, 0, 0);
        const to_frd = new THREE.Quaternion(1, 0, 0, 0);
        group.quaternion.copy(to_enu.multiply(q_nb).multiply(to_frd));
      }
      const [n, e, d] = state.vel_n_mps.map((v) => v ?? 0);
      const target = craft.point.clone().add(new THREE.Vector3(e, n, -d).multiplyScalar(moved_s));
      if (!craft.shown || craft.shown.distanceTo(target) > 30) craft.shown = target.clone();
      craft.shown.lerp(target, 0.5);
      group.position.copy(craft.shown);
      craft.path.end(craft.shown);
    },
    draw() {
      const now_ms = performance.now();
      for (const craft of Object.values(this.aircraft)) if (craft.state) this.pose(craft, now_ms);
      const craft = this.aircraft[mavgate.selected];
      const { clientWidth: width, clientHeight: height } = this.canvas;
      if (craft?.shown) this.fine.position.set(...[craft.shown.x, craft.shown.y].map((v) => Math.round(v / 10) * 10), 0);
      const stacked = height > width * 0.75;
      this.views.forEach((view, i) => {
        const camera = this.cameras[i];
        const size = stacked ? [width, height / 2] : [width / 2, height];
        const corner = stacked ? [0, i === 0 ? height / 2 : 0] : [i * size[0], 0];
        camera.aspect = size[0] / size[1];
        if (craft?.state) this.aim(view, camera, craft, i);
        for (const other of Object.values(this.aircraft)) {
          this.scale(other.group, camera, other === craft ? 0.13 : 0.07);
          other.group.visible = !(view === "cockpit" && other === craft);
        }
        this.scale(this.home, camera, 0.04);
        camera.updateProjectionMatrix();
        const ratio = this.renderer.getPixelRatio();
        for (const other of Object.values(this.aircraft)) other.path.resize(...size.map((pixels) => pixels * ratio));
        this.renderer.setViewport(...corner, ...size);
        this.renderer.setScissor(...corner, ...size);
        this.renderer.render(this.scene, camera);
      });
      this.$el.dataset.stacked = stacked;
      this.$el.dataset.model = craft?.model ?? "none";
      this.$el.dataset.frames = Number(this.$el.dataset.frames ?? 0) + 1;
    },
    // A model two metres wide would be invisible a kilometre away; it is drawn larger there: at
    // least this share of the view's height. The symbol of home is always smaller than an aircraft.
    scale(group, camera, share) {
      const distance = camera.position.distanceTo(group.position);
      const apparent = (2 * Math.tan((camera.fov * rad) / 2) * distance) / SPAN_M;
      group.scale.setScalar(Math.max(1, apparent * share));
    },
    aim(view, camera, craft, i) {
      const { position, quaternion } = craft.group;
      const forward = new THREE.Vector3(1, 0, 0).applyQuaternion(quaternion);
      const heading = Math.atan2(forward.y, forward.x);
      camera.up.set(0, 0, 1);
      camera.fov = 55;
      if (view === "chase" || view === "side") {
        const azimuth = heading + (view === "side" ? Math.PI / 2 : Math.PI) + this.swing.azimuth * rad;
        const elevation = this.swing.elevation * rad;
        const distance = this.swing.distance;
        camera.position.set(
          position.x + distance * Math.cos(elevation) * Math.cos(azimuth),
          position.y + distance * Math.cos(elevation) * Math.sin(azimuth),
          Math.max(position.z + distance * Math.sin(elevation), 0.4),
        );
        camera.lookAt(position);
      } else if (view === "cockpit") {
        camera.fov = 70;
        camera.up.set(0, 0, 1).applyQuaternion(quaternion);
        camera.position.copy(position).addScaledVector(forward, 0.4);
        camera.lookAt(camera.position.clone().add(forward));
      } else if (view === "above") {
        camera.up.set(0, 1, 0);
        camera.position.set(position.x, position.y, position.z + 160);
        camera.lookAt(position);
      } else {
        // A person ten metres south of home, with binoculars whose view includes some ground.
        camera.position.set(0, -10, 1.7);
        const distance = camera.position.distanceTo(position);
        camera.fov = Math.min(60, Math.max(9, (2 * Math.atan(40 / distance)) / rad));
        camera.lookAt(position);
        const [text, unit] = mavgate.show("distance", distance);
        this.notes[i] = `${text} ${unit}`;
        return;
      }
      this.notes[i] = "";
    },
    resize() {
      const { clientWidth, clientHeight } = this.$el;
      if (clientWidth && clientHeight) this.renderer?.setSize(clientWidth, clientHeight, false);
    },
    drag(event) {
      if (!(event.buttons & 1) || event.target.tagName === "SELECT") return;
      this.swing.azimuth -= event.movementX * 0.4;
      this.swing.elevation = Math.min(85, Math.max(-5, this.swing.elevation + event.movementY * 0.3));
    },
    wheel(event) {
      event.preventDefault();
      this.swing.distance = Math.min(200, Math.max(2.5, this.swing.distance * Math.exp(event.deltaY * 0.001)));
    },
  },
};
