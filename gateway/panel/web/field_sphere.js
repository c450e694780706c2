// SPDX-License-Identifier: Apache-2.0
// The measured magnetic field, on the sphere that a calibrated compass would give. Covered cells
// are filled, the others only outlined and hatched, so that they differ not by colour alone. The
// sphere turns slowly by itself, and by pointer or arrow keys.

const TILT = 0.42;
const TURN = 0.25; // rad/s

export default {
  template: `<canvas class="field-sphere" tabindex="0" role="img" :aria-label="spoken"></canvas>`,
  props: { cells: Array },
  data: () => ({ spoken: "Magnetic field: nothing measured yet" }),
  mounted() {
    this.points = [];
    this.seen = [];
    this.yaw = 0.6;
    this.tilt = TILT;
    const canvas = this.$el;
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      this.held = [e.clientX, e.clientY];
    });
    canvas.addEventListener("pointermove", (e) => {
      if (!this.held) return;
      this.turn((e.clientX - this.held[0]) * 0.01, (e.clientY - this.held[1]) * 0.01);
      this.held = [e.clientX, e.clientY];
    });
    canvas.addEventListener("pointerup", () => (this.held = null));
    canvas.addEventListener("keydown", (e) => {
      const by = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.15], ArrowDown: [0, 0.15] }[e.key];
      if (!by) return;
      e.preventDefault();
      this.turn(...by);
    });
    this.last = performance.now();
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const step = (now) => {
      if (!this.held && !still) this.yaw += ((now - this.last) / 1000) * TURN;
      this.last = now;
      if (canvas.offsetParent) this.draw();
      this.frame = requestAnimationFrame(step);
    };
    this.frame = requestAnimationFrame(step);
  },
  unmounted() {
    cancelAnimationFrame(this.frame);
  },
  methods: {
    // points: [[x, y, z]...] from the centre of the sphere, in its radii; seen: by cell.
    show(points, seen) {
      this.points = points;
      this.seen = seen;
      const count = seen.filter(Boolean).length;
      this.$el.dataset.points = points.length;
      this.$el.dataset.seen = count;
      this.spoken = points.length
        ? `Magnetic field: ${points.length} samples, ${count} of ${seen.length} directions seen`
        : "Magnetic field: nothing measured yet";
    },
    turn(yaw, tilt) {
      this.yaw += yaw;
      this.tilt = Math.max(-1.5, Math.min(1.5, this.tilt + tilt));
    },
    draw() {
      const canvas = this.$el;
      const { pen: g, width: size } = mavgate.pen_of(canvas, 2) ?? {};
      if (!g) return;
      const colour = mavgate.colour;
      const [cy, sy, ct, st] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.tilt), Math.sin(this.tilt)];
      const radius = size * 0.4;
      // NED seen from the side: z down the screen; depth grows towards the eye.
      const project = ([x, y, z]) => {
        const [u, v] = [x * cy - y * sy, x * sy + y * cy];
        return [size / 2 + u * radius, size / 2 + (z * ct - v * st) * radius, v * ct + z * st];
      };
      const cells = (this.cells ?? []).map((cell, n) => {
        const corners = cell.map(project);
        return { n, corners, depth: corners[0][2] + corners[1][2] + corners[2][2] };
      });
      cells.sort((a, b) => a.depth - b.depth);
      const points = this.points.map(project);
      const [good, line, track] = ["good", "line", "track"].map(colour);
      this.cellsOf(g, cells.filter((c) => c.depth < 0), good, line, 0.5);
      this.dots(g, points.filter((p) => p[2] < 0), track, 0.35);
      this.cellsOf(g, cells.filter((c) => c.depth >= 0), good, line, 1);
      this.dots(g, points.filter((p) => p[2] >= 0), track, 0.95);
    },
    cellsOf(g, cells, good, line, alpha) {
      for (const { n, corners } of cells) {
        g.beginPath();
        corners.forEach(([x, y], k) => (k ? g.lineTo(x, y) : g.moveTo(x, y)));
        g.closePath();
        g.globalAlpha = alpha * (this.seen[n] ? 0.28 : 1);
        if (this.seen[n]) {
          g.fillStyle = good;
          g.fill();
        }
        g.globalAlpha = alpha;
        g.strokeStyle = this.seen[n] ? good : line;
        g.setLineDash(this.seen[n] ? [] : [3, 3]);
        g.lineWidth = 1;
        g.stroke();
      }
      g.setLineDash([]);
      g.globalAlpha = 1;
    },
    dots(g, points, colour, alpha) {
      g.fillStyle = colour;
      g.globalAlpha = alpha;
      for (const [x, y, depth] of points) {
        g.beginPath();
        g.arc(x, y, 1.7 + 0.7 * depth, 0, 7);
        g.fill();
      }
      g.globalAlpha = 1;
    },
  },
};
