// SPDX-License-Identifier: Apache-2.0
// A strip chart of several fields over the last minutes. Python appends new data; following the
// present, pausing, zooming and saving an image are done here, in the browser.
import { echarts } from "nicegui-echart";

const KEPT_MS = 300_000;
const FOLLOW_MS = 200;
const LIGHT = ["#0072b2", "#d55e00", "#009e73", "#a3337a", "#9a6400", "#3d4a57"];
const DARK = ["#56b4e9", "#f09a3e", "#3ec9a0", "#e38ac0", "#f0e442", "#c3ced8"];
// The gateway's clock minus the browser's: all charts of a page have the same time axis.
let offset_ms = 0;
const DASHES = ["solid", "dashed", "dotted", [8, 3, 2, 3], [12, 4], [2, 6]];

export default {
  template: `<div class="strip-chart" role="img" :aria-label="spoken"></div>`,
  props: { options: Object, enable3d: Boolean, renderer: String, theme: null },
  data: () => ({ spoken: "Strip chart: no field chosen" }),
  mounted() {
    this.fields = [];
    this.data = [];
    this.windowMs = 60_000;
    this.paused = false;
    this.chart = echarts.init(this.$el, null, { renderer: "canvas" });
    this.chart.on("datazoom", () => this.noteZoom());
    this.sizes = new ResizeObserver(() => this.chart.resize());
    this.sizes.observe(this.$el);
    this.stop_theme = mavgate.watch_theme(() => this.layOut());
    this.$el.addEventListener("wheel", () => this.pauseByHand(), { passive: true });
    this.$el.addEventListener("pointerdown", () => this.pauseByHand());
    this.timer = setInterval(() => this.follow(), FOLLOW_MS);
    this.$emit("ready");
  },
  unmounted() {
    clearInterval(this.timer);
    this.sizes.disconnect();
    this.stop_theme();
    this.chart.dispose();
  },
  methods: {
    // fields: [{name, unit}]; data: one [[ms...], [value...]] a field; now_ms: the gateway's time.
    set_fields(fields, data, now_ms) {
      this.fields = fields;
      this.data = fields.map(() => []);
      this.append(data, now_ms);
      this.layOut();
    },
    append(data, now_ms) {
      const offset = now_ms - Date.now();
      if (Math.abs(offset - offset_ms) > FOLLOW_MS) offset_ms = offset;
      data.forEach(([times, values], n) => {
        const kept = this.data[n];
        if (!kept) return;
        for (let i = 0; i < times.length; i++) kept.push([times[i], values[i]]);
        const old = kept.findIndex(([ms]) => ms > now_ms - KEPT_MS);
        if (old > 500) kept.splice(0, old);
      });
    },
    set_window(seconds) {
      this.windowMs = seconds * 1000;
      if (this.paused) this.pause(true);
    },
    pause(paused) {
      this.paused = paused;
      if (paused) this.pausedAt = this.now();
      this.layOut();
    },
    // While wheel and drag zoom or move the chart, it must not scroll.
    pauseByHand() {
      if (this.paused || !this.fields.length) return;
      this.pause(true);
      this.$emit("paused");
    },
    range() {
      if (!this.paused) return [this.now() - this.windowMs, this.now()];
      const zoom = this.chart.getOption().dataZoom?.[0];
      return [zoom?.startValue ?? this.pausedAt - this.windowMs, zoom?.endValue ?? this.pausedAt];
    },
    picture() {
      return this.chart.getDataURL({ type: "png", pixelRatio: 2, backgroundColor: this.colour("card") });
    },
    now() {
      return Math.floor(Date.now() / FOLLOW_MS) * FOLLOW_MS + offset_ms;
    },
    colour(name) {
      return getComputedStyle(document.body).getPropertyValue(`--${name}`).trim();
    },
    // Beyond 2^53 a number has no exact digits; all digits of a damaged field would fill half the chart.
    label(value) {
      return Math.abs(value) < 2 ** 53 ? value.toLocaleString("en", { maximumFractionDigits: 10 }) : value.toExponential(1);
    },
    noteZoom() {
      const [from, to] = this.range();
      this.$el.dataset.spanS = ((to - from) / 1000).toFixed(1);
    },
    follow() {
      if (!this.paused && this.fields.length && this.$el.offsetParent) this.draw();
    },
    draw() {
      const now = this.now();
      const from = now - this.windowMs;
      const points = this.data.map((kept) => this.since(kept, from - 1000));
      this.chart.setOption({ xAxis: { min: from, max: now }, series: points.map((data) => ({ data })) });
      this.say(points);
    },
    since(kept, ms) {
      let low = 0;
      let high = kept.length;
      while (low < high) {
        const middle = (low + high) >> 1;
        if (kept[middle][0] < ms) low = middle + 1;
        else high = middle;
      }
      return kept.slice(low);
    },
    say(points) {
      this.$el.dataset.points = points.reduce((sum, data) => sum + data.length, 0);
      this.$el.dataset.spanS = (this.windowMs / 1000).toFixed(1);
      const newest = this.fields.map(({ name, unit }, n) => {
        const value = points[n].at(-1)?.[1];
        return `${name} ${Number.isFinite(value) ? value.toPrecision(4) : "unknown"} ${unit}`.trim();
      });
      this.spoken = newest.length ? `Strip chart: ${newest.join(", ")}` : "Strip chart: no field chosen";
    },
    layOut() {
      const dark = document.body.classList.contains("body--dark");
      const [ink, soft, grid] = ["ink", "soft", "grid"].map((name) => this.colour(name));
      const units = [...new Set(this.fields.map(({ unit }) => unit))];
      const text = { color: soft, fontSize: 11, fontFamily: "inherit" };
      const right = Math.max(0, units.length - 1);
      const now = this.paused ? this.pausedAt : this.now();
      this.chart.setOption(
        {
          animation: false,
          color: dark ? DARK : LIGHT,
          textStyle: { fontFamily: "system-ui, Roboto, sans-serif" },
          // The same margins in every chart, so that times are aligned.
          grid: { left: 62, right: 56 + 48 * Math.max(0, right - 1), top: 30, bottom: 26 },
          legend: {
            show: this.fields.length > 0, top: 2, left: 84, type: "scroll", itemWidth: 22, itemHeight: 8,
            textStyle: { ...text, color: ink }, pageTextStyle: text, pageIconColor: ink,
          },
          tooltip: {
            trigger: "axis", confine: true, backgroundColor: this.colour("raised"), borderColor: grid,
            textStyle: { color: ink, fontSize: 12 },
            valueFormatter: (v) => (Number.isFinite(v) ? Number(v.toPrecision(6)).toString() : "—"),
          },
          xAxis: {
            type: "time", min: this.paused ? now - KEPT_MS : now - this.windowMs, max: now,
            axisLabel: { ...text, hideOverlap: true, formatter: "{HH}:{mm}:{ss}" },
            axisLine: { lineStyle: { color: grid } }, splitLine: { show: true, lineStyle: { color: grid, opacity: 0.5 } },
          },
          yAxis: (units.length ? units : [""]).map((unit, n) => ({
            type: "value", scale: true, name: unit, nameTextStyle: text, position: n ? "right" : "left",
            offset: 48 * Math.max(0, n - 1), nameGap: 6,
            axisLabel: { ...text, formatter: this.label }, splitLine: { show: n === 0, lineStyle: { color: grid, opacity: 0.5 } },
          })),
          dataZoom: [
            {
              type: "inside", disabled: !this.paused, filterMode: "none",
              startValue: this.paused ? now - this.windowMs : undefined,
              endValue: this.paused ? now : undefined,
            },
          ],
          series: this.fields.map(({ name, unit }, n) => ({
            type: "line", name, symbol: "none", yAxisIndex: units.indexOf(unit), showSymbol: false, sampling: "lttb",
            lineStyle: { width: 2, type: DASHES[n % DASHES.length] }, data: this.data[n],
          })),
        },
        { notMerge: true },
      );
      if (this.paused) this.noteZoom();
      this.$el.dataset.paused = this.paused;
    },
  },
};
