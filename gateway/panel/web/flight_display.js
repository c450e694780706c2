// SPDX-License-Identifier: Apache-2.0
// The primary flight display. The page's feed sends a state some 25 times a second; between two of
// them the attitude is extrapolated by the body rates and the other values are smoothed, so that
// the display moves at the screen's own rate. It is drawn only while it changes.

const RAD = 180 / Math.PI;
const FULL_CLIMB = { metric: 6, imperial: 20, aviation: 1200 };
const TAU_S = 0.04; // of the glide: below two frames of a slow screen
const FORESEE_S = 0.12; // longest extrapolation by the newest rates
const STALE_S = 2;
const INK = "#f4f7fa";
const AMBER = "#ffb000";
const MARK = "#f0b3d6";
const BOX = "#0b1016";
const TAPE = "rgba(9,15,22,0.55)";

const known = (v) => typeof v === "number" && Number.isFinite(v);

function product(a, b) {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

function turned(q, rates, seconds) {
  const angle = Math.hypot(...rates) * seconds;
  if (!known(angle) || angle < 1e-9) return q;
  const s = (Math.sin(angle / 2) * seconds) / angle;
  return product(q, [Math.cos(angle / 2), rates[0] * s, rates[1] * s, rates[2] * s]);
}

export default {
  template: `<div class="flight-display" role="img" :aria-label="spoken"
    style="overflow: hidden; border-radius: 10px; background: #0b1016">
    <canvas ref="canvas" aria-hidden="true" style="display: block; width: 100%; height: 100%"></canvas>
  </div>`,
  data: () => ({ spoken: "Flight display: no aircraft" }),
  mounted() {
    this.goal = null;
    this.units = "metric";
    this.shown = {};
    this.spokenAt = 0;
    this.watcher = new ResizeObserver(() => this.fit());
    this.watcher.observe(this.$el);
    this.fit();
    this.leave = mavgate.subscribe((state) => this.show(state));
  },
  unmounted() {
    this.leave?.();
    mavgate.displayed = null;
    this.watcher.disconnect();
    cancelAnimationFrame(this.frame);
    clearTimeout(this.staleTimer);
  },
  methods: {
    show(instant) {
      const news = instant?.time_us !== this.goal?.time_us;
      if (!news && this.units === mavgate.units) return;
      this.units = mavgate.units;
      this.goal = instant;
      if (news) this.cameAt = performance.now();
      clearTimeout(this.staleTimer);
      this.staleTimer = setTimeout(() => this.wake(), STALE_S * 1000 + 50);
      this.wake();
    },
    wake() {
      this.moving = true;
      if (!this.frame) this.frame = requestAnimationFrame((now) => this.step(now));
    },
    fit() {
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      const { clientWidth: w, clientHeight: h } = this.$el;
      const canvas = this.$refs.canvas;
      canvas.width = Math.max(1, Math.round(w * ratio));
      canvas.height = Math.max(1, Math.round(h * ratio));
      this.ratio = ratio;
      this.wake();
    },
    step(now) {
      this.frame = 0;
      const dt = Math.min((now - (this.steppedAt ?? now)) / 1000, 0.1);
      this.steppedAt = now;
      this.advance(now, dt);
      this.draw(now);
      mavgate.show_numbers?.();
      if (this.moving) this.frame = requestAnimationFrame((t) => this.step(t));
      else this.steppedAt = undefined;
    },
    advance(now, dt) {
      const goal = this.goal;
      this.moving = false;
      if (!goal) {
        this.shown = {};
        return;
      }
      const age = Math.max(0, (now - this.cameAt) / 1000);
      const share = this.shown.fresh === goal.system_id ? 1 - Math.exp(-dt / TAU_S) : 1;
      const shown = { fresh: goal.system_id };
      if (goal.q_nb && goal.q_nb.every(known)) {
        const rates = goal.rate_b_radps && goal.rate_b_radps.every(known) ? goal.rate_b_radps : null;
        const ahead = rates ? turned(goal.q_nb, rates, Math.min(age, FORESEE_S)) : goal.q_nb;
        shown.q = this.shown.q ? mavgate.mixed(this.shown.q, ahead, share) : ahead;
        const dot = shown.q.reduce((sum, v, n) => sum + v * ahead[n], 0);
        if (age < FORESEE_S || Math.abs(dot) < 1 - 1e-9) this.moving = true;
      }
      const fields = ["groundspeed_mps", "airspeed_mps", "climb_mps", "alt_amsl_m", "alt_home_m"];
      for (const field of fields) {
        const to = goal[field];
        if (!known(to)) continue;
        const from = known(this.shown[field]) ? this.shown[field] : to;
        shown[field] = from + (to - from) * share;
        if (Math.abs(to - shown[field]) > 0.005) this.moving = true;
      }
      this.shown = shown;
      // The numbers show this moment too.
      mavgate.displayed = shown;
    },
    draw(now) {
      const canvas = this.$refs.canvas;
      const g = canvas.getContext("2d");
      g.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
      const w = canvas.width / this.ratio;
      const h = canvas.height / this.ratio;
      if (w < 40 || h < 40) return;
      const s = this.shown;
      // A state of the past that the user has chosen is never stale.
      const chosen = mavgate.past_us !== null;
      const stale = !this.goal || (!chosen && ((now - this.cameAt) / 1000 > STALE_S || this.goal.silent_s > 5));
      const [roll, pitch, yaw] = s.q ? mavgate.euler_deg(s.q) : [];
      const angles = s.q ? { roll, pitch, yaw } : null;
      const u = Math.min(w / 100, h / 75); // the unit of everything: 1 % of a 4:3 screen
      const font = (size) => `600 ${Math.max(size * u, 9).toFixed(1)}px "Roboto Condensed", Roboto, sans-serif`;
      const box = { g, u, w, h, font };
      this.horizon(box, angles);
      this.rollArc(box, angles);
      const [of_speed, of_height, of_climb] = ["speed", "altitude", "climb"].map(mavgate.scale);
      // A value that is smoothed towards zero never reaches it.
      const has_airspeed = known(s.airspeed_mps) && this.goal?.airspeed_mps > 0;
      const speed = has_airspeed ? s.airspeed_mps : s.groundspeed_mps;
      const speedName = has_airspeed ? "AS" : "GS";
      this.tape(box, true, speed, of_speed, speedName, s.groundspeed_mps);
      const height = known(s.alt_home_m) ? s.alt_home_m : s.alt_amsl_m;
      const heightName = known(s.alt_home_m) ? "HOME" : "AMSL";
      this.tape(box, false, height, of_height, heightName, s.alt_amsl_m);
      this.climb(box, s.climb_mps, of_climb);
      this.ribbon(box, angles);
      if (stale) this.cross(box, this.goal ? "NO ATTITUDE" : "NO AIRCRAFT");
      else if (!angles) this.cross(box, "NO ATTITUDE");
      this.say(now, angles, stale, [speed, of_speed], [height, of_height], [s.climb_mps, of_climb]);
    },
    horizon({ g, u, w, h, font }, angles) {
      const pitch = angles ? angles.pitch : 0;
      const roll = angles ? angles.roll : 0;
      const step = h / 50; // 50 degrees from top to bottom
      g.save();
      g.translate(w / 2, h / 2);
      g.rotate(-roll / RAD);
      g.translate(0, pitch * step);
      const far = w + h;
      const sky = g.createLinearGradient(0, -40 * step, 0, 0);
      sky.addColorStop(0, "#123a6b");
      sky.addColorStop(1, "#3f8fd0");
      const ground = g.createLinearGradient(0, 0, 0, 40 * step);
      ground.addColorStop(0, "#8a5f32");
      ground.addColorStop(1, "#3d2814");
      g.fillStyle = angles ? sky : "#27313b";
      g.fillRect(-far, -far - 90 * step, 2 * far, far + 90 * step);
      g.fillStyle = angles ? ground : "#1b222a";
      g.fillRect(-far, 0, 2 * far, far + 90 * step);
      g.strokeStyle = INK;
      g.lineWidth = Math.max(1.5, 0.35 * u);
      mavgate.line(g, [-far, 0], [far, 0]);
      this.ladder({ g, u, font }, pitch, step);
      g.restore();
      this.wings({ g, u, w, h });
    },
    ladder({ g, u, font }, pitch, step) {
      g.lineWidth = Math.max(1, 0.25 * u);
      g.font = font(2.5);
      g.textBaseline = "middle";
      g.fillStyle = INK;
      for (let deg = -90; deg <= 90; deg += 2.5) {
        if (deg === 0 || Math.abs(deg - pitch) > 16) continue;
        const long = deg % 10 === 0;
        const half = (long ? 9 : deg % 5 === 0 ? 5 : 2.2) * u;
        const y = -deg * step;
        g.globalAlpha = Math.min(1, (16 - Math.abs(deg - pitch)) / 4);
        g.setLineDash(deg < 0 ? [1.6 * u, 0.9 * u] : []);
        g.beginPath();
        if (long) g.moveTo(-half, y + Math.sign(deg) * 1.4 * u), g.lineTo(-half, y);
        else g.moveTo(-half, y);
        g.lineTo(half, y);
        if (long) g.lineTo(half, y + Math.sign(deg) * 1.4 * u);
        g.stroke();
        if (long) {
          g.textAlign = "right";
          g.fillText(Math.abs(deg), -half - u, y);
          g.textAlign = "left";
          g.fillText(Math.abs(deg), half + u, y);
        }
      }
      g.setLineDash([]);
      g.globalAlpha = 1;
    },
    wings({ g, u, w, h }) {
      g.save();
      g.translate(w / 2, h / 2);
      g.lineJoin = "round";
      for (const [color, width] of [["#000", 2.1 * u], [AMBER, 1.15 * u]]) {
        g.strokeStyle = color;
        g.lineWidth = width;
        g.beginPath();
        g.moveTo(-17 * u, 0);
        g.lineTo(-8 * u, 0);
        g.lineTo(-8 * u, 2.6 * u);
        g.moveTo(17 * u, 0);
        g.lineTo(8 * u, 0);
        g.lineTo(8 * u, 2.6 * u);
        g.stroke();
        g.fillStyle = color;
        g.beginPath();
        g.arc(0, 0, width * 0.62, 0, 7);
        g.fill();
      }
      g.restore();
    },
    rollArc({ g, u, w, h, font }, angles) {
      const radius = Math.min(27 * u, h / 2 - 4 * u);
      g.save();
      g.translate(w / 2, h / 2);
      g.strokeStyle = INK;
      g.lineWidth = Math.max(1.2, 0.3 * u);
      g.beginPath();
      g.arc(0, 0, radius, (-150 * Math.PI) / 180, (-30 * Math.PI) / 180);
      g.stroke();
      for (const deg of [10, 20, 30, 45, 60]) {
        for (const side of [-1, 1]) {
          g.save();
          g.rotate((side * deg) / RAD);
          mavgate.line(g, [0, -radius], [0, -radius - (deg % 30 === 0 ? 2.4 : 1.4) * u]);
          g.restore();
        }
      }
      g.fillStyle = INK;
      triangle(g, 0, -radius - 0.2 * u, 1.5 * u, -2.4 * u);
      if (angles) {
        g.rotate(-angles.roll / RAD);
        g.fillStyle = AMBER;
        triangle(g, 0, -radius + 0.4 * u, 1.6 * u, 2.6 * u);
      }
      g.restore();
    },
    tape({ g, u, w, h, font }, left, value, [factor, unit], name, second) {
      const width = 15 * u;
      const x = left ? 0 : w - width - climbWidth(u);
      const ribbonTop = h - 9 * u;
      const top = 5 * u;
      const middle = h / 2;
      const shown = known(value) ? value * factor : NaN;
      const span = niceSpan(factor, left);
      g.save();
      g.fillStyle = TAPE;
      g.fillRect(x, 0, width, ribbonTop);
      g.beginPath();
      g.rect(x, top, width, ribbonTop - top - 4 * u);
      g.clip();
      g.strokeStyle = INK;
      g.fillStyle = INK;
      g.lineWidth = Math.max(1, 0.22 * u);
      g.textBaseline = "middle";
      g.textAlign = left ? "right" : "left";
      g.font = font(2.9);
      const pixels = (h - 14 * u) / span.across;
      if (known(shown)) {
        const first = Math.ceil((shown - span.across / 2) / span.minor);
        for (let n = first; n * span.minor < shown + span.across / 2; n++) {
          const tick = n * span.minor;
          if (left && tick < 0) continue;
          const y = middle + (shown - tick) * pixels;
          const major = n % span.each === 0;
          const edge = left ? x + width : x;
          const inward = (left ? -1 : 1) * (major ? 2.2 : 1.2) * u;
          mavgate.line(g, [edge, y], [edge + inward, y]);
          if (major) g.fillText(Math.round(tick), edge + (left ? -3.2 : 3.2) * u, y);
        }
      }
      g.restore();
      this.readout({ g, u, font }, left, x, middle, width, shown);
      g.fillStyle = INK;
      g.textAlign = "center";
      g.textBaseline = "middle";
      g.font = font(2.4);
      g.fillText(`${name}  ${unit}`, x + width / 2, 2.6 * u);
      g.fillStyle = "#b9c6d2";
      const other = left ? "GS" : "AMSL";
      const text = known(second) ? (second * factor).toFixed(left ? 1 : 0) : "––";
      if (name !== other) g.fillText(`${other} ${text}`, x + width / 2, ribbonTop - 2.2 * u);
    },
    readout({ g, u, font }, left, x, middle, width, shown) {
      const half = 3.3 * u;
      const tip = left ? x + width + 1.6 * u : x - 1.6 * u;
      const base = left ? x + width - 0.8 * u : x + 0.8 * u;
      const back = left ? x + 0.4 * u : x + width - 0.4 * u;
      g.beginPath();
      g.moveTo(tip, middle);
      g.lineTo(base, middle - 1.6 * u);
      g.lineTo(base, middle - half);
      g.lineTo(back, middle - half);
      g.lineTo(back, middle + half);
      g.lineTo(base, middle + half);
      g.lineTo(base, middle + 1.6 * u);
      g.closePath();
      g.fillStyle = BOX;
      g.fill();
      g.strokeStyle = AMBER;
      g.lineWidth = Math.max(1, 0.25 * u);
      g.stroke();
      g.fillStyle = "#fff";
      g.font = font(4.3);
      g.textAlign = "center";
      g.textBaseline = "middle";
      const digits = left && shown < 99.95 ? 1 : 0;
      g.fillText(known(shown) ? plain(shown, digits) : "––", x + width / 2, middle + 0.2 * u);
    },
    climb({ g, u, w, h, font }, value, [factor, unit]) {
      const width = climbWidth(u);
      const x = w - width;
      const bottom = h - 9 * u;
      const top = 5 * u;
      const middle = h / 2;
      const full = FULL_CLIMB[this.units];
      const reach = Math.min(middle - top, bottom - middle) - Math.max(5.2 * u, 12);
      // A square-root scale, since small rates matter most in flight.
      const at = (v) => -Math.sign(v) * Math.sqrt(Math.min(Math.abs(v) / full, 1)) * reach;
      g.fillStyle = "rgba(9,15,22,0.72)";
      g.fillRect(x, 0, width, bottom);
      g.strokeStyle = INK;
      g.fillStyle = "#b9c6d2";
      g.font = font(1.9);
      g.lineWidth = Math.max(1, 0.2 * u);
      g.textAlign = "left";
      g.textBaseline = "middle";
      for (const share of [-1, -0.5, -1 / 6, 0, 1 / 6, 0.5, 1]) {
        const y = middle + at(share * full);
        mavgate.line(g, [x, y], [x + (share === 0 ? 2 : 1.1) * u, y]);
        if (share) g.fillText(Math.abs(share * full).toFixed(0), x + 1.6 * u, y);
      }
      g.textAlign = "center";
      g.fillText(unit, x + width / 2, 2.6 * u, width - 1.2 * u);
      if (!known(value)) return;
      const shown = value * factor;
      const y = at(shown);
      g.fillStyle = AMBER;
      g.fillRect(x + 0.1 * u, Math.min(middle, middle + y), 1.2 * u, Math.abs(y));
      g.font = font(2.2);
      g.fillStyle = INK;
      const text = full > 100 ? (Math.round(shown / 10) * 10).toFixed(0) : shown.toFixed(1);
      g.fillText(text, x + width / 2, bottom - Math.max(2.2 * u, 5), width - 1.2 * u);
    },
    ribbon({ g, u, w, h, font }, angles) {
      const height = 9 * u;
      const y = h - height;
      g.fillStyle = "rgba(9,15,22,0.8)";
      g.fillRect(0, y, w, height);
      const heading = angles ? angles.yaw : NaN;
      const pixels = w / 110;
      g.save();
      g.beginPath();
      g.rect(0, y, w, height);
      g.clip();
      g.strokeStyle = INK;
      g.fillStyle = INK;
      g.lineWidth = Math.max(1, 0.22 * u);
      g.textAlign = "center";
      g.textBaseline = "middle";
      if (known(heading)) {
        const names = { 0: "N", 90: "E", 180: "S", 270: "W" };
        const first = Math.ceil((heading - 60) / 5) * 5;
        for (let deg = first; deg < heading + 60; deg += 5) {
          const x = w / 2 + (deg - heading) * pixels;
          const round = ((deg % 360) + 360) % 360;
          mavgate.line(g, [x, y], [x, y + (round % 10 === 0 ? 1.9 : 1.1) * u]);
          if (round % 30) continue;
          g.font = font(round % 90 ? 2.7 : 3.4);
          g.fillText(names[round] ?? String(round).padStart(3, "0"), x, y + 4.4 * u);
        }
        this.bug({ g, u, w, y, pixels, font }, heading);
      }
      g.restore();
      g.fillStyle = BOX;
      g.strokeStyle = AMBER;
      g.lineWidth = Math.max(1, 0.25 * u);
      g.beginPath();
      g.roundRect(w / 2 - 6 * u, y + 1.2 * u, 12 * u, 6.4 * u, 0.8 * u);
      g.fill();
      g.stroke();
      g.fillStyle = "#fff";
      g.textAlign = "center";
      g.textBaseline = "middle";
      g.font = font(4.3);
      const text = known(heading) ? String(Math.round(heading) % 360).padStart(3, "0") + "°" : "–––";
      g.fillText(text, w / 2 + 0.4 * u, y + 4.6 * u);
    },
    bug({ g, u, w, y, pixels, font }, heading) {
      const { mark, lat_deg, lon_deg } = this.goal ?? {};
      if (!mark || !known(lat_deg)) return;
      const bearing = mavgate.bearing_deg([lat_deg, lon_deg], [mark.lat_deg, mark.lon_deg]);
      const half = w / 2 - 1.5 * u;
      const off = Math.max(-half, Math.min(half, mavgate.wrap_deg(bearing - heading) * pixels));
      g.fillStyle = MARK;
      triangle(g, w / 2 + off, y + 6.2 * u, 1.5 * u, 2.4 * u);
    },
    cross({ g, u, w, h, font }, text) {
      g.save();
      g.fillStyle = "rgba(12,16,21,0.72)";
      g.fillRect(0, 0, w, h);
      g.strokeStyle = "#d55e00";
      g.lineWidth = 0.8 * u;
      g.beginPath();
      g.moveTo(w * 0.2, h * 0.2);
      g.lineTo(w * 0.8, h * 0.8);
      g.moveTo(w * 0.8, h * 0.2);
      g.lineTo(w * 0.2, h * 0.8);
      g.stroke();
      g.font = font(5);
      g.textAlign = "center";
      g.textBaseline = "middle";
      const wide = g.measureText(text).width + 6 * u;
      g.fillStyle = BOX;
      g.fillRect((w - wide) / 2, h / 2 - 5 * u, wide, 10 * u);
      g.strokeRect((w - wide) / 2, h / 2 - 5 * u, wide, 10 * u);
      g.fillStyle = "#ffd9c2";
      g.fillText(text, w / 2, h / 2);
      g.restore();
    },
    say(now, angles, stale, speed, height, climb) {
      this.$el.dataset.timeUs = this.goal?.time_us ?? "";
      if (now - this.spokenAt < 200 && this.moving) return;
      this.spokenAt = now;
      if (stale || !angles) {
        this.spoken = this.goal ? "Flight display: no attitude" : "Flight display: no aircraft";
        return;
      }
      const in_ = ([v, [factor, name]]) => (known(v) ? `${plain(v * factor, 1)} ${name}` : "unknown");
      this.spoken =
        `Roll ${plain(angles.roll, 1)}°, pitch ${plain(angles.pitch, 1)}°, ` +
        `heading ${angles.yaw.toFixed(1)}°, speed ${in_(speed)}, ` +
        `altitude ${in_(height)}, climb ${in_(climb)}`;
    },
  },
};

// A number as text, without the sign of a zero.
const plain = (value, digits) => value.toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1");

function triangle(g, x, y, half, height) {
  g.beginPath();
  g.moveTo(x, y);
  g.lineTo(x - half, y + height);
  g.lineTo(x + half, y + height);
  g.closePath();
  g.fill();
}

// Width of the climb scale, whose longest label is 1200 ft/min; the smallest font needs 34 pixels.
const climbWidth = (u) => Math.max(7 * u, 34);

// The visible span of a tape, and its ticks, legible at a glance in every unit.
function niceSpan(factor, isSpeed) {
  if (isSpeed) return factor > 1.5 ? { across: 40, minor: 2, each: 5 } : { across: 20, minor: 1, each: 5 };
  return factor > 1.5 ? { across: 200, minor: 10, each: 5 } : { across: 60, minor: 5, each: 2 };
}
