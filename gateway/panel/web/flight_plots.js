// SPDX-License-Identifier: Apache-2.0
// Plots of a flight over time, with one time axis: wheel and drag zoom all of them, a click moves
// to a time.
const LIGHT = ["#0072b2", "#d55e00", "#009e73", "#a3337a", "#9a6400", "#3d4a57"];
const DARK = ["#56b4e9", "#f09a3e", "#3ec9a0", "#e38ac0", "#f0e442", "#c3ced8"];
const DASHES = [[], [7, 4], [2, 3], [8, 3, 2, 3], [12, 4], [2, 6]];
const LEFT = 56;
const RIGHT = 10;
const BOTTOM = 20;
const WHOLE_TURN = [-8, 368]; // of headings, with a margin
const LEAST_MARKS = 5; // of the time axis
const NARROW = 620; // below it the names of the lines have a row of their own

export default {
  template: `
    <section class="card flight-plots" aria-label="Plots">
      <div v-for="(group, n) in groups" :key="group.title" :class="{ plot: true, small: group.is_small }">
        <canvas :ref="(canvas) => (canvases[n] = canvas)" role="img" :aria-label="group.title"
          @wheel.prevent="zoom" @pointerdown="grab" @pointermove="drag" @pointerup="drop" @dblclick="whole"></canvas>
      </div>
      <p class="soft" v-if="groups.length">The wheel zooms, dragging moves, a double click shows the whole flight, a click goes to a moment.</p>
    </section>`,
  props: { groups: Array, at: Number, end: Number },
  emits: ["seek"],
  data: () => ({ from: 0, to: null }),
  created() {
    this.canvases = [];
  },
  mounted() {
    this.size = new ResizeObserver(() => this.draw_all());
    this.size.observe(this.$el);
    this.stop_theme = mavgate.watch_theme(() => this.draw_all());
    for (const name of ["at", "groups", "from", "to"]) this.$watch(name, () => this.wake(), { flush: "post" });
    this.draw_all();
  },
  unmounted() {
    this.size.disconnect();
    this.stop_theme();
  },
  methods: {
    wake() {
      this.handle ??= requestAnimationFrame(() => {
        this.handle = undefined;
        this.draw_all();
      });
    },
    span() {
      return [this.from, this.to ?? this.end];
    },
    draw_all() {
      this.groups.forEach((group, n) => this.canvases[n] && this.draw(this.canvases[n], group));
    },
    draw(canvas, group) {
      const { pen, width, height } = mavgate.pen_of(canvas) ?? {};
      if (!pen) return;
      const [from, to] = this.span();
      const narrow = width < NARROW;
      const top = narrow ? 42 : 26;
      const x = (t) => LEFT + ((t - from) / (to - from)) * (width - LEFT - RIGHT);
      const [low, high] = group.is_heading ? WHOLE_TURN : range_of(group.series, from, to);
      const y = (v) => height - BOTTOM - ((v - low) / (high - low)) * (height - top - BOTTOM);
      const [ink, soft, line] = ["ink", "soft", "line"].map(mavgate.colour);
      pen.font = "12px system-ui, sans-serif";
      pen.lineWidth = 1;
      pen.textBaseline = "middle";
      pen.textAlign = "right";
      for (const tick of group.is_heading ? [0, 90, 180, 270, 360] : ticks(low, high, 4)) {
        pen.strokeStyle = line;
        mavgate.line(pen, [LEFT, y(tick)], [width - RIGHT, y(tick)]);
        pen.fillStyle = soft;
        pen.fillText(Number(tick.toPrecision(6)), LEFT - 6, y(tick));
      }
      pen.textAlign = "center";
      for (const tick of ticks(from, to, Math.max(LEAST_MARKS, width / 110), [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600])) {
        pen.strokeStyle = line;
        mavgate.line(pen, [x(tick), top], [x(tick), height - BOTTOM]);
        pen.fillStyle = soft;
        pen.fillText(mavgate.clock(tick), x(tick), height - 8);
      }
      const colours = document.body.classList.contains("body--dark") ? DARK : LIGHT;
      pen.textAlign = "left";
      pen.fillStyle = ink;
      pen.font = "600 12px system-ui, sans-serif";
      const title = group.unit ? `${group.title} (${group.unit})` : group.title;
      pen.fillText(title, LEFT, 12);
      let label_x = narrow ? LEFT : LEFT + pen.measureText(title).width + 16;
      const label_y = narrow ? 29 : 12;
      pen.font = "12px system-ui, sans-serif";
      pen.save();
      group.series.forEach(({ name }, n) => {
        pen.strokeStyle = pen.fillStyle = colours[n % colours.length];
        pen.setLineDash(DASHES[n % DASHES.length]);
        pen.lineWidth = 2;
        mavgate.line(pen, [label_x, label_y], [label_x + 20, label_y]);
        pen.fillText(name, label_x + 25, label_y);
        label_x += 41 + pen.measureText(name).width;
      });
      pen.beginPath();
      pen.rect(LEFT, top, width - LEFT - RIGHT, height - top - BOTTOM);
      pen.clip();
      pen.lineJoin = "round";
      group.series.forEach((series, n) => {
        pen.strokeStyle = colours[n % colours.length];
        pen.setLineDash(DASHES[n % DASHES.length]);
        pen.lineWidth = 1.7;
        pen.stroke(path_of(series, from, to, x, y, width, group.unit === "°" ? 180 : Infinity));
      });
      pen.setLineDash([]);
      pen.fillStyle = mavgate.colour("accent");
      pen.fillRect(x(this.at) - 0.75, top, 1.5, height);
      pen.restore();
    },
    time_at(event) {
      const box = event.currentTarget.getBoundingClientRect();
      const [from, to] = this.span();
      return from + ((event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT)) * (to - from);
    },
    show(from, to) {
      const span = Math.min(this.end, Math.max(2, to - from));
      this.from = Math.min(Math.max(0, from), this.end - span);
      this.to = this.from + span;
    },
    zoom(event) {
      const [from, to] = this.span();
      const middle = this.time_at(event);
      const factor = Math.exp(event.deltaY * 0.0015);
      this.show(middle - (middle - from) * factor, middle + (to - middle) * factor);
    },
    grab(event) {
      event.currentTarget.setPointerCapture(event.pointerId);
      this.held = { time: this.time_at(event), x: event.clientX, moved: false };
    },
    drag(event) {
      if (!this.held) return;
      this.held.moved ||= Math.abs(event.clientX - this.held.x) > 4;
      if (!this.held.moved) return;
      const [from, to] = this.span();
      const by = this.held.time - this.time_at(event);
      this.show(from + by, to + by);
    },
    drop(event) {
      if (this.held && !this.held.moved) this.$emit("seek", this.time_at(event));
      this.held = null;
    },
    whole() {
      this.from = 0;
      this.to = null;
    },
  },
};

function range_of(series, from, to) {
  let low = Infinity;
  let high = -Infinity;
  for (const { time_s, values } of series)
    for (let n = 0; n < values.length; n++) {
      const v = values[n];
      if (v === null || !Number.isFinite(v) || time_s[n] < from || time_s[n] > to) continue;
      if (v < low) low = v;
      if (v > high) high = v;
    }
  if (low > high) return [0, 1];
  const margin = Math.max((high - low) * 0.06, 0.5);
  return [low - margin, high + margin];
}

// The path of a series, interrupted at a larger step; of many points in one column of pixels only
// the extremes are drawn.
function path_of({ time_s, values }, from, to, x, y, width, leap) {
  const path = new Path2D();
  const begin = Math.max(0, time_s.findIndex((t) => t >= from) - 1);
  let count = 0;
  while (begin + count < time_s.length && time_s[begin + count] <= to) count += 1;
  const step = Math.max(1, Math.floor(count / (2 * width)));
  let is_open = false;
  let last = NaN;
  for (let n = begin; n <= begin + count && n < values.length; n += step) {
    let [low, high] = [n, n];
    for (let m = n; m < Math.min(n + step, values.length); m++) {
      if (values[m] === null) continue;
      if (values[low] === null || values[m] < values[low]) low = m;
      if (values[high] === null || values[m] > values[high]) high = m;
    }
    if (values[low] === null) {
      is_open = false;
      continue;
    }
    for (const m of low < high ? [low, high] : low === high ? [low] : [high, low]) {
      // No line across the plot where an angle wraps from 360 to 0 degrees.
      if (is_open && Math.abs(values[m] - last) <= leap) path.lineTo(x(time_s[m]), y(values[m]));
      else path.moveTo(x(time_s[m]), y(values[m]));
      is_open = true;
      last = values[m];
    }
  }
  return path;
}

function ticks(low, high, count, steps) {
  const wanted = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const step = steps?.find((s) => s >= wanted) ?? [1, 2, 5, 10].find((s) => s * power >= wanted) * power;
  const found = [];
  for (let n = Math.ceil(low / step); n * step <= high; n++) found.push(n * step);
  return found;
}
