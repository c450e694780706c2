// SPDX-License-Identifier: Apache-2.0
// A slider through a played recording, which shows the altitudes of its aircraft: that of the
// chosen one filled, those of the others as lines.
export default {
  template: `
    <div class="flight-timeline spring">
      <span class="figure flight-time">{{ text }}</span>
      <div class="time-slider" ref="slider" role="slider" tabindex="0" aria-label="Moment of the playback"
        :aria-valuemin="0" :aria-valuemax="Math.round(duration)" :aria-valuenow="Math.round(shown)"
        :aria-valuetext="text" @pointerdown="grab" @pointermove="drag" @pointerup="drop" @keydown="key">
        <canvas ref="canvas"></canvas>
      </div>
    </div>`,
  props: { curves: Array, duration: Number, position: Number, playing: Boolean, speed: Number },
  data: () => ({ held: null, shown: 0 }),
  computed: {
    text() {
      return `${mavgate.clock(this.shown)} of ${mavgate.clock(this.duration)}`;
    },
  },
  mounted() {
    this.updated_ms = performance.now();
    this.size = new ResizeObserver(() => this.draw());
    this.size.observe(this.$refs.slider);
    for (const name of ["curves", "duration"]) this.$watch(name, () => this.draw());
    this.$watch("position", () => (this.updated_ms = performance.now()));
    const turn = () => {
      this.handle = requestAnimationFrame(turn);
      if (!this.$el.offsetParent) return;
      const ahead = this.playing ? ((performance.now() - this.updated_ms) / 1000) * this.speed : 0;
      const now = this.held ?? Math.min(this.position + Math.min(ahead, this.speed), this.duration);
      if (Math.abs(now - this.shown) < this.duration / 4000) return;
      this.shown = now;
      this.draw();
    };
    turn();
    this.draw();
  },
  unmounted() {
    cancelAnimationFrame(this.handle);
    this.size?.disconnect();
  },
  methods: {
    draw() {
      const { slider, canvas } = this.$refs;
      const { pen, width, height } = mavgate.pen_of(canvas) ?? {};
      if (!pen) return;
      const x = (s) => (this.duration ? (s / this.duration) * width : 0);
      const [chosen, ...others] = this.curves;
      const heights = this.curves.flatMap((curve) => curve.alt_amsl_m);
      const low = Math.min(...heights);
      const high = Math.max(...heights, low + 1);
      const y = (h) => height - 8 - ((h - low) / (high - low)) * (height - 12);
      const line = ({ time_s, alt_amsl_m }) => {
        const path = new Path2D();
        time_s.forEach((t, i) => path.lineTo(x(t), y(alt_amsl_m[i])));
        return path;
      };
      if (chosen?.time_s.length) {
        const path = line(chosen);
        path.lineTo(x(chosen.time_s.at(-1)), height);
        path.lineTo(x(chosen.time_s[0]), height);
        pen.fillStyle = mavgate.colour("line");
        pen.fill(path);
        pen.save();
        pen.beginPath();
        pen.rect(0, 0, x(this.shown), height);
        pen.clip();
        pen.fillStyle = mavgate.colour("accent");
        pen.globalAlpha = 0.45;
        pen.fill(path);
        pen.restore();
      }
      if (heights.length) {
        pen.strokeStyle = mavgate.colour("soft");
        for (const other of others) pen.stroke(line(other));
      }
      pen.fillStyle = mavgate.colour("accent");
      pen.fillRect(x(this.shown) - 1, 0, 2, height);
      pen.beginPath();
      pen.arc(Math.min(Math.max(x(this.shown), 6), width - 6), height - 7, 6, 0, 7);
      pen.fill();
      slider.dataset.points = chosen?.time_s.length ?? 0;
      slider.dataset.curves = this.curves.length;
    },
    at(event) {
      return mavgate.share_of(event, this.$refs.slider) * this.duration;
    },
    grab(event) {
      event.currentTarget.setPointerCapture(event.pointerId);
      this.held = this.at(event);
    },
    drag(event) {
      if (this.held !== null) this.held = this.at(event);
    },
    drop(event) {
      if (this.held === null) return;
      this.$emit("seek", this.at(event));
      setTimeout(() => (this.held = null), 600);
    },
    key(event) {
      if (event.key === " ") event.preventDefault(); // the page scrolls no further; the shell plays
      const step = mavgate.step_of(event);
      if (step === undefined) return;
      this.$emit("seek", Math.min(this.duration, Math.max(0, this.shown + step)));
    },
  },
};
