// SPDX-License-Identifier: Apache-2.0
// A whole flight in one page: the panel's widgets, moved by a slider instead of by telemetry.
import display from "./flight_display.js";
import scene from "./flight_scene.js";
import map from "./flight_map.js";
import numbers from "./number_strip.js";
import plots from "./flight_plots.js";

const SPEEDS = [0.5, 1, 2, 5, 10, 50];
const SEVERITIES = ["Emergency", "Alert", "Critical", "Error", "Warning", "Notice", "Info", "Debug"];
const PARTS = [
  ["Height above home", "m", [["alt_home_m", "above home"]]],
  ["Height above sea", "m", [["alt_amsl_m", "above sea"]], false, true],
  ["Speed", "m/s", [["groundspeed_mps", "ground speed"], ["airspeed_mps", "airspeed"], ["climb_mps", "climb"]]],
  ["Attitude", "°", [["roll_deg", "roll"], ["pitch_deg", "pitch"]]],
  ["Heading", "°", [["heading_deg", "heading"]], true],
  ["Position accuracy", "m", [["pos_std_m", "standard deviation"]]],
  ["Satellites", "", [["satellites", "satellites"]]],
  ["Battery", "V", [["battery_v", "voltage"]]],
];
const COMPARED = [["roll_deg", "Roll", "°"], ["pitch_deg", "Pitch", "°"], ["yaw_deg", "Heading", "°", true], ["alt_amsl_m", "Height above sea", "m"]];
const YEAR_2000_US = 946_684_800_000_000; // an earlier time is that of no calendar
const rad = Math.PI / 180;

function column({ r, d }) {
  let last = 0;
  return d.map((step) => (step === null ? null : ((last += step), last * r)));
}

function columns_of(packed) {
  const columns = Object.fromEntries(Object.entries(packed).map(([name, values]) => [name, column(values)]));
  const missing = columns.time_us.map(() => null);
  for (const name of ["q_nb.0", "q_nb.1", "q_nb.2", "q_nb.3", "rate_b_radps.0", "rate_b_radps.1", "rate_b_radps.2", "vel_n_mps.0", "vel_n_mps.1", "vel_n_mps.2"]) columns[name] ??= missing;
  for (const name of ["alt_amsl_m", "alt_home_m", "groundspeed_mps", "airspeed_mps", "climb_mps", "heading_deg", "pos_std_m", "fix_type", "satellites", "battery_v", "battery_percent"]) columns[name] ??= missing;
  return columns;
}

// Roll and pitch of every row, for the plots.
function add_angles(columns) {
  const [w, x, y, z] = [0, 1, 2, 3].map((n) => columns[`q_nb.${n}`]);
  const angles = { roll_deg: [], pitch_deg: [] };
  w.forEach((_, n) => {
    const known = w[n] !== null;
    angles.roll_deg.push(known ? Math.atan2(2 * (w[n] * x[n] + y[n] * z[n]), 1 - 2 * (x[n] ** 2 + y[n] ** 2)) / rad : null);
    angles.pitch_deg.push(known ? Math.asin(Math.max(-1, Math.min(1, 2 * (w[n] * y[n] - z[n] * x[n])))) / rad : null);
  });
  return angles;
}

export default {
  components: { display, scene, "flight-map": map, numbers, plots },
  template: `
    <header class="page-head">
      <h1>{{ flight.name }}</h1>
      <span class="soft">{{ facts }}</span>
      <span class="spring"></span>
      <select v-if="ids.length > 1" v-model="selected" aria-label="Aircraft"><option v-for="id in ids" :key="id" :value="id">{{ titles[id] }}</option></select>
      <select v-model="units" aria-label="Units"><option>metric</option><option>imperial</option><option>aviation</option></select>
      <button type="button" @click="theme" aria-label="Light or dark">{{ dark ? "Light" : "Dark" }}</button>
    </header>
    <main class="page-main">
      <section class="card" aria-label="Flight in numbers"><numbers /></section>
      <div class="page-views">
        <section class="card page-display"><display class="fill" /></section>
        <section class="card page-map"><flight-map :styles="[]" :full="false" :may_mark="false" /></section>
        <section class="card page-scene"><scene /></section>
      </div>
      <section class="card page-player" aria-label="Player">
        <button type="button" class="play" @click="toggle" :aria-label="playing ? 'Pause' : 'Play'">{{ playing ? "❚❚" : "▶" }}</button>
        <input type="range" min="0" :max="duration_s" step="any" :value="at_s" @input="go(Number($event.target.value))" aria-label="Moment of the flight" :aria-valuetext="text">
        <span class="figure" data-role="clock">{{ text }}</span>
        <select v-model.number="speed" aria-label="Speed"><option v-for="s in speeds" :key="s" :value="s">{{ s }}×</option></select>
      </section>
      <plots :groups="groups" :at="at_s" :end="duration_s" @seek="go" />
      <section class="card page-events" v-if="flight.texts.length">
        <h2>Events</h2>
        <ol><li v-for="([time_s, system_id, severity, words], n) in flight.texts" :key="n" :class="{ bad: severity < 4, warn: severity === 4 }">
          <button type="button" @click="go(time_s)" :title="'Go to ' + clock(time_s)">{{ clock(time_s) }}</button>
          <b>{{ severities[severity] ?? severity }}</b> {{ words }}
        </li></ol>
      </section>
      <section class="card page-events" v-if="flight.remarks.length"><h2>Remarks</h2><p v-for="(remark, n) in flight.remarks" :key="n">{{ remark }}</p></section>
      <footer class="soft">Made by mavgate. Space plays and pauses, arrow keys move by 5 s, page keys by a minute, + and − change the speed.</footer>
    </main>`,
  props: { flight: Object },
  data() {
    return { at_s: 0, playing: false, speed: 1, speeds: SPEEDS, units: "metric", dark: false, ids: [], selected: null, duration_s: 1, severities: SEVERITIES };
  },
  computed: {
    text() {
      return `${mavgate.clock(this.at_s)} of ${mavgate.clock(this.duration_s)}`;
    },
    facts() {
      const begin = this.flight.begin_us > YEAR_2000_US ? `${new Date(this.flight.begin_us / 1000).toISOString().slice(0, 16).replace("T", " ")} UTC, ` : "";
      const { distance_m, airborne_s, highest_m, height_above } = this.flight.aircraft.find(({ system_id }) => String(system_id) === this.selected);
      const height = highest_m === null ? "" : `, highest ${Math.round(highest_m)} m above ${height_above}`;
      return `${begin}${mavgate.duration(this.duration_s)}, ${(distance_m / 1000).toFixed(2)} km, in the air ${mavgate.clock(airborne_s)}${height}`;
    },
    groups() {
      const columns = mavgate.histories[this.selected];
      if (!columns) return [];
      const time_s = columns.time_us.map((us) => us / 1e6);
      const all = { ...columns, ...this.angles[this.selected] };
      const shown = PARTS.map(([title, unit, series, is_heading, is_small]) => ({
        title, unit, is_heading, is_small, series: series.filter(([key]) => all[key]?.some((v) => Number.isFinite(v) && v !== 0)).map(([key, name]) => ({ name, time_s, values: all[key] })),
      })).filter(({ series }) => series.length);
      const compared = Object.entries(this.compared);
      for (const [key, title, unit, is_heading] of compared.length ? COMPARED : [])
        shown.push({ title: `${title}, estimators compared`, unit, is_heading, series: compared.map(([name, one]) => ({ name, time_s: one.time_us.map((us) => us / 1e6), values: one[key] })) });
      return shown;
    },
  },
  created() {
    this.angles = {};
    this.titles = Object.fromEntries(this.flight.aircraft.map(({ system_id, title }) => [system_id, title]));
    this.compared = Object.fromEntries(Object.entries(this.flight.compared).map(([name, packed]) => [name, Object.fromEntries(Object.entries(packed).map(([key, values]) => [key, column(values)]))]));
    for (const aircraft of this.flight.aircraft) {
      const id = String(aircraft.system_id);
      const columns = (mavgate.histories[id] = columns_of(aircraft.columns));
      this.angles[id] = add_angles(columns);
      mavgate.vehicles[id] = { system_id: aircraft.system_id, title: aircraft.title, model: aircraft.model, origin: "live", generation: 0, battery_name: aircraft.battery_name, home: aircraft.home, mark: null, lat_deg: columns.lat_deg[0], lon_deg: columns.lon_deg[0], alt_amsl_m: columns.alt_amsl_m[0] };
      const track = mavgate.track(id);
      const has_height = columns.alt_amsl_m.some((alt) => alt !== null);
      const points = columns.lat_deg.map((lat, n) => [lat, columns.lon_deg[n], columns.alt_amsl_m[n], columns.time_us[n]]);
      // A track has heights, or it lies at zero.
      track.points = points.filter(([lat, , alt]) => lat !== null && (alt !== null || !has_height)).map(([lat, lon, alt, us]) => [lat, lon, alt ?? 0, us]);
      track.breaks = new Set(aircraft.breaks.map((us) => track.points.findIndex(([, , , time_us]) => time_us >= us - 500)));
      track.version = 1;
      this.duration_s = Math.max(this.duration_s, columns.time_us.at(-1) / 1e6);
    }
    this.ids = Object.keys(mavgate.histories);
    this.selected = this.ids[0];
    mavgate.selected = this.selected;
    mavgate.seek(0);
    this.set_theme(matchMedia("(prefers-color-scheme: dark)").matches);
  },
  mounted() {
    this.$watch("units", (units) => {
      mavgate.units = units;
      this.go(this.at_s);
    });
    this.$watch("selected", (id) => {
      mavgate.selected = id;
      this.go(this.at_s);
    });
    document.addEventListener("keydown", (event) => this.key(event));
    let last_ms = null;
    const turn = (now_ms) => {
      if (this.playing && last_ms !== null) this.go(this.at_s + (Math.min(now_ms - last_ms, 500) / 1000) * this.speed);
      last_ms = now_ms;
      if (this.at_s >= this.duration_s) this.playing = false;
      requestAnimationFrame(turn);
    };
    requestAnimationFrame(turn);
    this.go(this.first_s());
  },
  methods: {
    clock: (seconds) => mavgate.clock(seconds),
    // Where attitude, position and height are known, if they are at any time.
    first_s() {
      const columns = mavgate.histories[this.selected];
      const all = ["q_nb.0", "lat_deg", "alt_amsl_m"].filter((name) => columns[name].some((value) => value !== null));
      const at = columns.time_us.findIndex((_, n) => all.every((name) => columns[name][n] !== null));
      return at > 0 ? columns.time_us[at] / 1e6 : 0;
    },
    go(seconds) {
      this.at_s = Math.min(this.duration_s, Math.max(0, seconds));
      mavgate.now_us = this.at_s * 1e6;
      mavgate.seek(this.at_s * 1e6);
    },
    toggle() {
      if (!this.playing && this.at_s >= this.duration_s) this.go(0);
      this.playing = !this.playing;
    },
    theme() {
      this.set_theme(!this.dark);
    },
    set_theme(dark) {
      this.dark = dark;
      document.body.classList.toggle("body--dark", dark);
    },
    key(event) {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("select, textarea, input:not([type=range])")) return;
      const step = { ArrowLeft: -5, ArrowRight: 5, PageDown: -60, PageUp: 60, Home: -Infinity, End: Infinity }[event.key];
      if (step !== undefined) this.go(this.at_s + step);
      else if (event.key === " " && event.target.tagName !== "BUTTON") this.toggle();
      else if (event.key === "+" || event.key === "-") {
        const n = SPEEDS.indexOf(this.speed) + (event.key === "+" ? 1 : -1);
        this.speed = SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, n))];
      } else if (event.key === "t") this.theme();
      else return;
      event.preventDefault();
    },
  },
};
