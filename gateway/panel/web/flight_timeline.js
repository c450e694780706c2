// SPDX-License-Identifier: Apache-2.0
// The current flight over time: its height, and a handle that shows the past or the present.
const RELOAD_MS = 5000;

export default {
  template: `
    <div class="flight-timeline">
      <span class="figure flight-time">{{ text }}</span>
      <div class="time-slider" role="slider" tabindex="0" aria-label="Moment of the flight" :aria-valuemin="0"
        :aria-valuemax="Math.round(span_s)" :aria-valuenow="Math.round(at_s)" :aria-valuetext="text"
        @pointerdown="grab" @pointermove="drag" @pointerup="held = false" @keydown="key">
        <canvas ref="canvas"></canvas>
      </div>
      <button type="button" :aria-pressed="live" @click="to_live" title="Show the present">{{ live ? "● Live" : "Go to live" }}</button>
    </div>`,
  data: () => ({ span_s: 0, at_s: 0, live: true, text: "no flight yet" }),
  mounted() {
    this.held = false;
    this.loaded_ms = -RELOAD_MS;
    this.loading = false;
    this.size = new ResizeObserver(() => this.draw());
    this.size.observe(this.$el);
    this.stop_theme = mavgate.watch_theme(() => this.draw());
    this.stop = mavgate.subscribe(() => this.refresh());
  },
  unmounted() {
    this.stop?.();
    this.stop_theme?.();
    this.size?.disconnect();
  },
  methods: {
    async refresh() {
      this.live = mavgate.past_us === null;
      if (!this.$el.offsetParent || mavgate.selected === null) return;
      if (this.loading || performance.now() - this.loaded_ms < RELOAD_MS) {
        this.say();
        return;
      }
      this.loading = true;
      this.loaded_ms = performance.now();
      try {
        await mavgate.load_history(mavgate.selected);
      } catch {
        return; // the next one may come through
      } finally {
        this.loading = false;
      }
      this.say();
      this.draw();
    },
    history() {
      return mavgate.histories[mavgate.selected];
    },
    say() {
      const times = this.history()?.time_us;
      if (!times?.length) return;
      this.span_s = (Math.max(mavgate.now_us, times.at(-1)) - times[0]) / 1e6;
      this.at_s = this.live ? this.span_s : (mavgate.past_us - times[0]) / 1e6;
      const back = Math.round(this.span_s - this.at_s);
      this.text = this.live ? mavgate.duration(this.span_s) : `${mavgate.duration(back)} ago`;
      this.draw();
    },
    draw() {
      const { pen, width, height } = mavgate.pen_of(this.$refs.canvas) ?? {};
      if (!pen) return;
      const { time_us: times, alt_amsl_m: heights } = this.history() ?? {};
      if (!times?.length || !this.span_s) return;
      const known = heights.filter(Number.isFinite);
      const low = Math.min(...known);
      const high = Math.max(...known, low + 1);
      const x = (us) => ((us - times[0]) / 1e6 / this.span_s) * width;
      pen.beginPath();
      pen.moveTo(0, height);
      times.forEach((us, n) => Number.isFinite(heights[n]) && pen.lineTo(x(us), height - 2 - ((heights[n] - low) / (high - low)) * (height - 6)));
      pen.lineTo(x(times.at(-1)), height);
      pen.fillStyle = mavgate.colour("line");
      pen.fill();
      pen.fillStyle = mavgate.colour(this.live ? "good" : "accent");
      pen.fillRect(Math.min(width - 3, (this.at_s / this.span_s) * width - 1), 0, 3, height);
    },
    go(seconds) {
      const times = this.history()?.time_us;
      if (!times?.length) return;
      if (seconds >= this.span_s - 0.5) this.to_live();
      else mavgate.seek(times[0] + Math.max(0, seconds) * 1e6);
      this.live = mavgate.past_us === null;
      this.say();
    },
    to_live() {
      mavgate.seek(null);
      this.live = true;
      this.say();
    },
    at(event) {
      return mavgate.share_of(event, this.$refs.canvas) * this.span_s;
    },
    grab(event) {
      event.currentTarget.setPointerCapture(event.pointerId);
      this.held = true;
      this.go(this.at(event));
    },
    drag(event) {
      if (this.held) this.go(this.at(event));
    },
    key(event) {
      const step = mavgate.step_of(event, { Home: -this.span_s, End: this.span_s });
      if (step !== undefined) this.go(this.at_s + step);
    },
  },
};
