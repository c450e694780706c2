// SPDX-License-Identifier: Apache-2.0
// The page's telemetry: the newest state, path and past of every aircraft, and the subscribers.
//
// A page of the panel calls connect(), after which states come over one WebSocket; a page that
// contains a whole flight sets `histories` and calls seek() instead.
(() => {
  const FACTORS = {
    metric: { speed: [1, "m/s"], altitude: [1, "m"], climb: [1, "m/s"], length: [1, "m"], distance: [1000, "km"] },
    imperial: { speed: [0.44704, "mph"], altitude: [0.3048, "ft"], climb: [0.3048, "ft/s"], length: [0.3048, "ft"], distance: [1609.344, "mi"] },
    aviation: { speed: [1852 / 3600, "kt"], altitude: [0.3048, "ft"], climb: [0.3048 / 60, "ft/min"], length: [0.3048, "ft"], distance: [1852, "NM"] },
  };
  const FAR_M = 1000;
  const GAP_US = 1_500_000; // a longer gap in the states is filled from the server's path
  const STEP_M = 1;
  const MAX_POINTS = 20000;
  const EARTH_M = 6378137;
  const rad = Math.PI / 180;
  const subscribers = new Set();
  const tracks = {};

  const bus = {
    vehicles: {},
    state: null,
    selected: null,
    units: "metric",
    connected: false,
    received_ms: 0,
    now_us: 0,
    past_us: null, // the moment of the past that is shown instead of the present
    histories: {},

    subscribe(callback) {
      subscribers.add(callback);
      if (bus.state) callback(bus.state);
      return () => subscribers.delete(callback);
    },
    select(system_id) {
      bus.selected = system_id === null ? null : String(system_id);
      bus.seek(null);
    },
    // An SI value in the page's units: [text, unit].
    show(quantity, value, digits = 1) {
      if (!Number.isFinite(value)) return ["—", FACTORS[bus.units][quantity][1]];
      if (quantity === "distance" && Math.abs(value) < FAR_M) [quantity, digits] = ["length", 0];
      const [factor, unit] = FACTORS[bus.units][quantity];
      return [(value / factor).toFixed(digits), unit];
    },
    factor: (quantity) => FACTORS[bus.units][quantity][0],
    // The page's unit of a quantity: its number per SI unit, and its name.
    scale: (quantity) => [1 / FACTORS[bus.units][quantity][0], FACTORS[bus.units][quantity][1]],
    wrap_deg,
    mixed,
    // Roll, pitch and yaw of a quaternion in degrees.
    euler_deg: ([w, x, y, z]) => [
      Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) / rad,
      Math.asin(Math.max(-1, Math.min(1, 2 * (w * y - z * x)))) / rad,
      (Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) / rad + 360) % 360,
    ],
    // Draws a line through points.
    line(pen, begin, ...points) {
      pen.beginPath();
      pen.moveTo(...begin);
      for (const point of points) pen.lineTo(...point);
      pen.stroke();
    },
    // A time of a flight: 3:12, 1:03:12.
    clock(seconds) {
      const [h, m, s] = parts_of(seconds);
      const two = (n) => String(n).padStart(2, "0");
      return h ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
    },
    // A duration, which must not look like a time of day: 14 min 42 s.
    duration(seconds) {
      const [h, m, s] = parts_of(seconds);
      return h ? `${h} h ${m} min` : m ? `${m} min ${s} s` : `${s} s`;
    },
    // A colour of the style sheet, in the form for canvas and WebGL.
    colour: (name) => getComputedStyle(document.body).getPropertyValue(`--${name}`).trim(),
    // Clears a canvas at screen resolution; returns its context and its size in CSS pixels.
    pen_of(canvas, most = Infinity) {
      const { clientWidth: width, clientHeight: height } = canvas ?? {};
      if (!width) return null;
      const ratio = Math.min(window.devicePixelRatio || 1, most);
      const size = [Math.round(width * ratio), Math.round(height * ratio)];
      if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
      const pen = canvas.getContext("2d");
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.clearRect(0, 0, width, height);
      return { pen, width, height };
    },
    // The position of a pointer as a share of an element's width.
    share_of(event, element) {
      const box = element.getBoundingClientRect();
      return Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    },
    // The seconds by which a key moves a time slider, after stopping the event; else undefined.
    step_of(event, ends = {}) {
      const step = { ArrowLeft: -5, ArrowRight: 5, PageDown: -60, PageUp: 60, ...ends }[event.key];
      if (step === undefined) return undefined;
      event.preventDefault();
      event.stopPropagation();
      return step;
    },
    // Calls back when the page becomes dark or light, not at other changes of the body's classes.
    watch_theme(callback) {
      const is_dark = () => document.body.classList.contains("body--dark");
      let dark = is_dark();
      const observer = new MutationObserver(() => {
        if (is_dark() === dark) return;
        dark = is_dark();
        callback();
      });
      observer.observe(document.body, { attributes: true, attributeFilter: ["class"] });
      return () => observer.disconnect();
    },
    // The shown state of an aircraft: the present one, or that of the chosen time.
    shown(id) {
      if (bus.past_us === null) return bus.vehicles[id];
      if (id === bus.selected) return bus.state;
      return bus.histories[id] ? state_at(bus.histories[id], bus.past_us, bus.vehicles[id]) : bus.vehicles[id];
    },
    // The path of an aircraft: `points` and `fixes`, whose items begin with [lat, lon, alt,
    // time_us]. They only grow at their end while `version` stays.
    track: (id) => (tracks[id] ??= new_track()),
    clear_tracks() {
      for (const track of Object.values(tracks)) reset(track);
    },
    distance_m(a, b) {
      const north = (b[0] - a[0]) * rad * EARTH_M;
      const east = wrap_deg(b[1] - a[1]) * rad * EARTH_M * Math.cos(a[0] * rad);
      return Math.hypot(north, east);
    },
    bearing_deg([lat, lon], [to_lat, to_lon]) {
      const turn = (to_lon - lon) * rad;
      const y = Math.sin(turn) * Math.cos(to_lat * rad);
      const x = Math.cos(lat * rad) * Math.sin(to_lat * rad) - Math.sin(lat * rad) * Math.cos(to_lat * rad) * Math.cos(turn);
      return (Math.atan2(y, x) / rad + 360) % 360;
    },
    // Shows a past time of the selected aircraft; null is the present.
    seek(time_us) {
      bus.past_us = time_us;
      choose_state();
      publish();
    },
    async load_history(id) {
      const answer = await fetch(`/history/${id}`);
      if (!answer.ok) return null;
      return (bus.histories[id] = await answer.json());
    },
    connect(page = "") {
      if (connecting) return;
      connecting = true;
      open(page);
    },
  };
  window.mavgate = bus;

  function wrap_deg(angle) {
    return ((((angle + 180) % 360) + 360) % 360) - 180;
  }

  // Interpolates between two quaternions.
  function mixed(p, q, share) {
    const sign = p.reduce((sum, v, n) => sum + v * q[n], 0) < 0 ? -1 : 1;
    const sum = p.map((v, n) => v + (sign * q[n] - v) * share);
    const norm = Math.hypot(...sum);
    return sum.map((v) => v / norm);
  }

  function parts_of(seconds) {
    const whole = Math.max(0, Math.floor(seconds));
    return [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  }

  function publish() {
    for (const callback of subscribers) {
      try {
        callback(bus.state);
      } catch (error) {
        console.error(error);
      }
    }
  }

  function choose_state() {
    const now = bus.vehicles[bus.selected] ?? null;
    const history = bus.histories[bus.selected];
    bus.state = bus.past_us === null || !history ? now : state_at(history, bus.past_us, now);
  }

  // The state at a time of a history, interpolated; missing fields are taken from `now`.
  function state_at(history, time_us, now) {
    const times = history.time_us;
    let low = 0;
    let high = times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= time_us) low = middle;
      else high = middle - 1;
    }
    const next = Math.min(low + 1, times.length - 1);
    const span = times[next] - times[low];
    const share = span > 0 && span < 3 * GAP_US ? Math.min(1, Math.max(0, (time_us - times[low]) / span)) : 0;
    const state = { ...now, time_us, silent_s: 0, fix: null, mark: now?.mark ?? null };
    for (const [name, column] of Object.entries(history)) {
      if (name === "time_us") continue;
      const [field, index] = name.split(".");
      const [a, b] = [column[low], column[next]];
      let value = a === null || b === null ? a : a + (b - a) * share;
      if (field === "heading_deg" && a !== null && b !== null) value = (a + wrap_deg(b - a) * share + 360) % 360;
      if (index === undefined) state[field] = value;
      else (state[field] = index === "0" ? [] : state[field])[index] = value;
    }
    const [p, q] = [low, next].map((row) => [0, 1, 2, 3].map((n) => history[`q_nb.${n}`][row]));
    if (p[0] !== null && q[0] !== null) state.q_nb = mixed(p, q, share);
    return state;
  }
  bus.state_at = state_at;

  function new_track() {
    return { points: [], fixes: [], version: 0, generation: null, time_us: null, loading: false, fix: "" };
  }

  function reset(track) {
    track.points = [];
    track.fixes = [];
    track.fix = "";
    track.version += 1;
  }

  function follow(id, state) {
    const track = bus.track(id);
    if (track.generation !== state.generation) {
      if (track.generation !== null) reset(track);
      track.generation = state.generation;
    }
    if (state.lat_deg === null) return;
    // Also after another view was shown: the server has the points received since.
    if (track.time_us === null || bus.now_us - track.time_us > GAP_US) fill(id, track);
    track.time_us = bus.now_us;
    add(track, [state.lat_deg, state.lon_deg, state.alt_amsl_m ?? 0, bus.now_us]);
    if (state.fix && track.fix !== (track.fix = `${state.fix.lat_deg} ${state.fix.lon_deg}`)) {
      track.fixes.push([state.fix.lat_deg, state.fix.lon_deg]);
    }
  }

  function add(track, point) {
    const last = track.points.at(-1);
    if (last && bus.distance_m(last, point) < STEP_M && Math.abs(last[2] - point[2]) < STEP_M) return;
    track.points.push(point);
    if (track.points.length > MAX_POINTS) {
      track.points.splice(0, MAX_POINTS / 4);
      track.version += 1;
    }
  }

  async function fill(id, track) {
    if (track.loading) return;
    track.loading = true;
    const from = track.points.length;
    try {
      const answer = await fetch(`/path/${id}`);
      if (!answer.ok) return;
      const { track: points, fixes } = await answer.json();
      const since = track.points.slice(from);
      reset(track);
      for (const point of [...points, ...since]) add(track, point);
      track.fixes = fixes.slice(-MAX_POINTS);
    } catch {
      track.time_us = null;
    } finally {
      track.loading = false;
    }
  }

  let connecting = false;
  let wait_ms = 250;
  function open(page) {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/telemetry?page=${encodeURIComponent(page)}`);
    socket.onopen = () => {
      wait_ms = 250;
      bus.connected = true;
    };
    socket.onmessage = (event) => {
      const news = JSON.parse(event.data);
      bus.vehicles = news.vehicles;
      bus.now_us = news.time_us;
      bus.received_ms = performance.now();
      for (const [id, state] of Object.entries(news.vehicles)) follow(id, state);
      for (const id of Object.keys(tracks)) if (!(id in news.vehicles)) delete tracks[id];
      if (bus.past_us === null) choose_state();
      publish();
      if (socket.readyState === WebSocket.OPEN) socket.send("1");
    };
    socket.onclose = () => {
      bus.connected = false;
      setTimeout(open, wait_ms, page);
      wait_ms = Math.min(wait_ms * 2, 4000);
    };
  }
})();
