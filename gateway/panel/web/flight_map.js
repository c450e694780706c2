// SPDX-License-Identifier: Apache-2.0
// The map: separate fused track and GPS fixes, home, mark, accuracy; below them tiles, or a coarse
// map of the world, or a metric grid.
import { leaflet as L } from "nicegui-leaflet";

const EARTH_M = 6378137;
const rad = Math.PI / 180;
const CIRCLE_95 = 2.4477 / Math.SQRT2; // of the root of both axes' variances, as a radius
const MAX_DOTS = 2000;
const MAX_TOWNS = 60;
const LINE_GAP = 90; // least pixels between two lines of the grid
const GRID_ZOOM = 9; // from here on the grid is drawn over the coarse map
const FAR_ZOOM = 13; // below it home is a small ring
const NEAR_ZOOM = 14; // from here on the coarse map, accurate to kilometres, shows nothing
const AIRCRAFT = {
  plane: "M16 2c1.4 0 2 2 2 5v5l12 6v3l-12-3v7l4 3v2l-6-1.6L10 30v-2l4-3v-7L2 21v-3l12-6V7c0-3 .6-5 2-5z",
  copter: "M16 3l4 7h-8zM8 8a5 5 0 1 1-.1 0zM24 8a5 5 0 1 1-.1 0zM8 19a5 5 0 1 1-.1 0zM24 19a5 5 0 1 1-.1 0zM13 12h6v9h-6z",
  none: "M16 3l9 25-9-6-9 6z",
};
const ORIGINS = { live: ["track", "live"], recorded: ["recorded", "recorded"], "fused again": ["fused-again", "fused again"] };
const look_of = (state) => (ORIGINS[state.origin] ?? ORIGINS.live)[0];
const icon = (html, size) => L.divIcon({ html, className: "map-icon", iconSize: [size, size], iconAnchor: [size / 2, size / 2] });
const at = (spot) => [spot.lat_deg, spot.lon_deg];

// A canvas over the whole map, which is redrawn whenever the map moves.
const CanvasLayer = L.Layer.extend({
  onAdd(map) {
    this.canvas = L.DomUtil.create("canvas", this.options.className, map.getPane(this.options.pane));
    map.on("move zoom resize viewreset", this.draw, this);
    this.draw();
  },
  onRemove(map) {
    this.canvas.remove();
    map.off("move zoom resize viewreset", this.draw, this);
  },
  draw() {
    const map = this._map;
    if (!map) return;
    const size = map.getSize();
    const ratio = window.devicePixelRatio || 1;
    L.DomUtil.setPosition(this.canvas, map.containerPointToLayerPoint([0, 0]));
    this.canvas.width = size.x * ratio;
    this.canvas.height = size.y * ratio;
    this.canvas.style.width = `${size.x}px`;
    this.canvas.style.height = `${size.y}px`;
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    this.fill(pen, map, size);
  },
});

// Lines every 1, 2 or 5 times ten to the n metres from home, with their distance at the edge.
const MetricGrid = CanvasLayer.extend({
  options: { pane: "grid", className: "map-grid" },
  origin: null,
  least_zoom: 0,
  fill(pen, map, size) {
    pen.fillStyle = mavgate.colour("map");
    pen.fillRect(0, 0, size.x, size.y);
    if (!this.origin || map.getZoom() < this.least_zoom) return;
    const [lat, lon] = this.origin;
    const here = map.latLngToContainerPoint(this.origin);
    // Projected, because points of the container are rounded.
    const degree = map.project([lat, lon + 1]).x - map.project([lat, lon]).x;
    const per_m = degree / (rad * Math.cos(lat * rad) * EARTH_M);
    const quantity = LINE_GAP / per_m < 1000 ? "length" : "distance";
    const per_unit = per_m * mavgate.factor(quantity);
    const wanted = LINE_GAP / per_unit;
    const power = 10 ** Math.floor(Math.log10(wanted));
    const step = [1, 2, 5, 10].find((times) => times * power >= wanted) * power;
    this.canvas.dataset.step = step;
    const unit = mavgate.show(quantity, 1e9)[1];
    const pixels = step * per_unit;
    pen.strokeStyle = mavgate.colour("grid");
    pen.fillStyle = mavgate.colour("soft");
    pen.font = "10px system-ui";
    pen.lineWidth = 1;
    const lines = (from, end, origin, draw) => {
      for (let n = Math.ceil((from - origin) / pixels); origin + n * pixels <= end; n++) {
        pen.globalAlpha = n % 5 === 0 ? 0.9 : 0.45;
        draw(origin + n * pixels, `${Math.round(n * step * 1000) / 1000} ${unit}`);
      }
    };
    const stroke = (x1, y1, x2, y2) => mavgate.line(pen, [x1, y1], [x2, y2]);
    lines(0, size.x, here.x, (x, text) => {
      stroke(x, 0, x, size.y);
      pen.fillText(text, x + 3, size.y - 5);
    });
    lines(0, size.y, here.y, (y, text) => {
      stroke(0, y, size.x, y);
      pen.fillText(text.startsWith("-") ? text.slice(1) : text === `0 ${unit}` ? text : `-${text}`, 4, y - 3);
    });
  },
});

// The names of towns that do not overlap, the most important first.
const TownNames = CanvasLayer.extend({
  options: { pane: "base", className: "map-towns" },
  towns: [],
  fill(pen, map, size) {
    pen.font = "12px system-ui";
    pen.fillStyle = mavgate.colour("soft");
    const view = map.getBounds().pad(0.05);
    const taken = [];
    for (const [name, position] of this.towns) {
      if (taken.length >= MAX_TOWNS) break;
      if (!view.contains(position)) continue;
      const { x, y } = map.latLngToContainerPoint(position);
      const box = [x - 4, y - 9, x + 12 + pen.measureText(name).width, y + 9];
      if (taken.some(([left, top, right, low]) => left < box[2] && box[0] < right && top < box[3] && box[1] < low)) continue;
      taken.push(box);
      pen.beginPath();
      pen.arc(x, y, 2.5, 0, 2 * Math.PI);
      pen.fill();
      pen.fillText(name, x + 6, y + 4);
    }
    this.canvas.dataset.names = taken.length;
  },
});

// Read the coarse map, once for all maps of a page.
let base_map = null;
function load_base_map(url) {
  base_map ??= fetch(url).then((answer) => answer.json()).then(({ unit_deg, coasts, borders, towns }) => {
    const position = (x, y) => [y * unit_deg, x * unit_deg];
    const line = (steps) => {
      let [x, y] = steps;
      const points = [position(x, y)];
      for (let n = 2; n < steps.length; n += 2) points.push(position((x += steps[n]), (y += steps[n + 1])));
      return points;
    };
    return { coasts: coasts.map(line), borders: borders.map(line), towns: towns.map(([name, x, y]) => [name, position(x, y)]) };
  });
  return base_map;
}

// The length of a round number of the page's units.
const Scale = L.Control.Scale.extend({
  _addScales(options, className, container) {
    this._bar = L.DomUtil.create("div", className, container);
  },
  _updateScales(longest_m) {
    const quantity = longest_m < mavgate.factor("distance") ? "length" : "distance";
    const longest = longest_m / mavgate.factor(quantity);
    const shown = this._getRoundNum(longest);
    this._updateScale(this._bar, `${shown} ${mavgate.show(quantity, NaN)[1]}`, shown / longest);
  },
});

export default {
  template: `
    <div class="map" :data-follow="follow">
      <div class="map-canvas" ref="map"></div>
      <div class="map-tools">
        <select v-if="styles.length" v-model="style" aria-label="Map style" class="map-style">
          <option v-for="(s, i) in styles" :key="i" :value="i">{{ s.name }}</option>
          <option :value="-1">Grid</option>
        </select>
        <button :aria-pressed="follow" @click="follow = !follow" title="Keep the aircraft in the middle">{{ follow ? "Following" : "Follow" }}</button>
        <button v-if="full" @click="fit" title="Show all of the path">Fit</button>
        <button v-if="full" @click="clear" title="Clear the drawn path">Clear path</button>
        <slot></slot>
      </div>
      <div class="map-offline" v-if="offline" role="status">no map tiles (offline)</div>
      <div class="map-position" v-if="position">
        <span class="figure" data-role="position">{{ position }}</span>
        <button @click="copy" title="Copy latitude and longitude">{{ copied ? "Copied" : "Copy" }}</button>
      </div>
      <form class="map-entry" v-if="full" @submit.prevent="locate">
        <input v-model="entry" placeholder="latitude, longitude" aria-label="Coordinates to show" :aria-invalid="entry !== '' && !entered">
        <button type="submit" :disabled="!entered" title="Show these coordinates">Show</button>
        <button type="button" v-if="may_mark" :disabled="!entered" @click="locate() || ask(entered)" title="Mark these coordinates or set home there">Mark …</button>
      </form>
      <div class="map-ask" v-if="asked" ref="ask" role="dialog" :aria-label="'Position ' + asked.text" :style="asked.style" @keydown.esc="asked = null">
        <span class="figure title">{{ asked.text }}</span>
        <span class="soft">{{ asked.title }}</span>
        <button type="button" @click="act('mark')">Mark this position</button>
        <button type="button" @click="act('home')">Set home here …</button>
        <button type="button" v-if="asked.has_mark" @click="act('clear')">Clear the mark</button>
        <button type="button" @click="asked = null">Cancel</button>
      </div>
      <div class="map-legend" v-if="full || paths.length > 1">
        <span v-for="[look, name] in paths" :key="look" class="key" :class="look" data-role="path">{{ paths.length > 1 ? name : "path" }}</span>
        <span v-if="full && has_fixes" class="key fix">GPS</span>
        <span class="key circle" v-if="full && circle">95 % within {{ circle }}</span>
        <span class="key mark" v-if="full && way" data-role="way">{{ way }}</span>
        <span class="key home" v-if="full && sight" data-role="sight">{{ sight }}</span>
      </div>
    </div>`,
  props: { styles: Array, full: Boolean, may_mark: Boolean, base: String },
  computed: {
    // The coordinates in the entry field, or null.
    entered() {
      const numbers = this.entry.match(/-?\d+(\.\d+)?/g)?.map(Number) ?? [];
      const [lat_deg, lon_deg] = numbers;
      return numbers.length === 2 && Math.abs(lat_deg) <= 90 && Math.abs(lon_deg) <= 180 ? { lat_deg, lon_deg } : null;
    },
  },
  data: () => ({ follow: true, style: 0, position: "", copied: false, way: "", sight: "", circle: "", paths: [], has_fixes: false, offline: false, entry: "", asked: null }),

  mounted() {
    const map = (this.map = L.map(this.$refs.map, {
      center: [0, 0], zoom: 3, zoomControl: this.full, attributionControl: true, preferCanvas: true, worldCopyJump: true,
    }));
    map.attributionControl.setPrefix("");
    map.createPane("grid").style.zIndex = 150;
    map.createPane("base").style.zIndex = 160;
    map.createPane("fixes").style.zIndex = 390;
    this.scale = new Scale().addTo(map);
    this.grid = new MetricGrid().addTo(map);
    this.dots = L.canvas({ pane: "fixes" });
    this.craft = {};
    this.mark = L.marker([0, 0], { icon: icon('<svg viewBox="0 0 24 24" class="pin mark"><path d="M12 1v22M1 12h22M12 5a7 7 0 1 0 .1 0z"/></svg>', 26), interactive: false, keyboard: false });
    this.bearing = L.polyline([], { weight: 2, dashArray: "6 6" });
    this.antenna = L.polyline([], { weight: 1.5, dashArray: "2 5", interactive: false });
    this.home = L.marker([0, 0], { icon: icon('<div class="pin home">H</div>', 22), interactive: false, keyboard: false });
    this.accuracy = L.circle([0, 0], { radius: 1, weight: 1, fillOpacity: 0.12, interactive: false });
    map.on("click", (event) => this.may_mark && this.ask({ lat_deg: event.latlng.lat, lon_deg: event.latlng.wrap().lng }));
    map.on("move zoom resize", () => this.asked && this.place_question());
    map.on("dragstart", () => (this.follow = false));
    this.$watch("style", () => this.set_style());
    // An added map is shown if there was none.
    this.$watch("styles", (now) => {
      if (this.offline || !this.tiles) this.style = now.length - 1;
    });
    this.$watch("offline", () => this.set_base());
    map.on("zoomend", () => this.set_base());
    // At a lower zoom the symbol of home would cover names.
    map.on("zoomend", () => (this.$el.dataset.far = map.getZoom() < FAR_ZOOM));
    this.set_style();
    this.paint();
    this.stop_theme = mavgate.watch_theme(() => this.paint());
    this.size = new ResizeObserver(() => map.invalidateSize({ animate: false }));
    this.size.observe(this.$el);
    this.stop = mavgate.subscribe(() => (this.stale = true));
    let drawn_ms = 0;
    const draw = (now_ms) => {
      this.handle = requestAnimationFrame(draw);
      if (!this.stale || now_ms - drawn_ms < 60 || !this.$el.offsetParent) return;
      drawn_ms = now_ms;
      this.stale = false;
      this.draw();
    };
    draw(100);
    this.$el.mavgate_map = map;
  },
  unmounted() {
    cancelAnimationFrame(this.handle);
    this.stop?.();
    this.stop_theme?.();
    this.size?.disconnect();
    this.map?.remove();
  },

  methods: {
    set_style() {
      this.tiles?.remove();
      this.offline = false;
      const style = this.styles[this.style];
      this.set_base();
      if (!style) return;
      // A missing tile is an error; the owner is named only if a tile is shown.
      const options = { maxZoom: 22, maxNativeZoom: style.max_zoom, errorTileUrl: "" };
      let loaded = 0;
      this.tiles = L.tileLayer(`/tiles/${this.style}/{z}/{x}/{y}`, options);
      this.tiles.on("loading", () => (loaded = 0));
      this.tiles.on("tileload", () => {
        loaded += 1;
        this.offline = false;
        if (style.attribution && this.tiles.options.attribution !== style.attribution) {
          this.tiles.options.attribution = style.attribution;
          this.map.attributionControl.addAttribution(style.attribution);
        }
      });
      this.tiles.on("tileerror", () => (this.offline = loaded === 0));
      this.tiles.addTo(this.map);
    },
    // Show the coarse map if there are no tiles, unless the grid was chosen.
    async set_base() {
      const has_none = () => this.base && this.style >= 0 && (this.offline || !this.styles.length);
      const wanted = () => has_none() && this.map.getZoom() < NEAR_ZOOM;
      if (wanted() && !this.world) {
        const { coasts, borders, towns } = await load_base_map(this.base);
        if (this.world || !this.map) return;
        const options = { renderer: L.canvas({ pane: "base" }), weight: 1, interactive: false, attribution: "Made with Natural Earth" };
        this.coasts = L.polyline(coasts, options);
        this.borders = L.polyline(borders, { ...options, dashArray: "4 3" });
        this.towns = new TownNames();
        this.towns.towns = towns;
        this.world = L.layerGroup([this.coasts, this.borders, this.towns]);
        this.paint();
      }
      this.toggle(this.world, wanted(), () => {});
      this.grid.least_zoom = has_none() ? GRID_ZOOM : 0;
      this.grid.draw();
    },
    paint() {
      this.mark_colour = mavgate.colour("mark");
      this.coasts?.setStyle({ color: mavgate.colour("terrain-line") });
      this.borders?.setStyle({ color: mavgate.colour("soft") });
      this.towns?.draw();
      this.bearing.setStyle({ color: this.mark_colour });
      this.antenna.setStyle({ color: mavgate.colour("home") });
      this.accuracy.setStyle({ color: mavgate.colour("track"), fillColor: mavgate.colour("track") });
      for (const one of Object.values(this.craft)) {
        one.track.setStyle({ color: mavgate.colour(one.colour) });
        one.fixes.eachLayer((dot) => dot.setStyle({ color: mavgate.colour("fix") }));
      }
      this.grid.draw();
    },
    make(id, state) {
      const path = `<svg viewBox="0 0 32 32" class="craft"><path d="${AIRCRAFT[state.model] ?? AIRCRAFT.none}"/></svg>`;
      const one = {
        marker: L.marker(at(state), { icon: icon(path, 34), title: state.title, interactive: false, keyboard: false }).addTo(this.map),
        version: -1,
        colour: look_of(state),
        track: L.polyline([], { color: mavgate.colour(look_of(state)), weight: 3, interactive: false }).addTo(this.map),
        fixes: L.layerGroup().addTo(this.map),
      };
      return one;
    },
    // Update the drawn path from that of the telemetry.
    draw_track(id, one) {
      const track = mavgate.track(id);
      const flat = ([lat, lon]) => [lat, lon];
      if (one.version !== track.version) {
        one.version = track.version;
        // A recorded path has the gaps of the recording.
        const parts = [[]];
        track.points.forEach((point, n) => {
          if (track.breaks?.has(n)) parts.push([]);
          parts.at(-1).push(flat(point));
        });
        one.track.setLatLngs(parts);
        one.fixes.clearLayers();
        one.points = track.points.length;
        one.dots = Math.max(0, track.fixes.length - MAX_DOTS);
      }
      for (; one.points < track.points.length; one.points++) one.track.addLatLng(flat(track.points[one.points]));
      for (; one.dots < track.fixes.length; one.dots++) this.dot(one, flat(track.fixes[one.dots]));
    },
    dot(one, position) {
      L.circleMarker(position, { pane: "fixes", radius: 1.8, weight: 1, fill: false, color: mavgate.colour("fix"), interactive: false, renderer: this.dots }).addTo(one.fixes);
      const dots = one.fixes.getLayers();
      if (dots.length > MAX_DOTS + 500) for (const old of dots.slice(0, 500)) one.fixes.removeLayer(old);
    },
    draw() {
      for (const id of Object.keys(mavgate.vehicles)) {
        const state = mavgate.shown(id);
        if (state.lat_deg === null) continue;
        const one = (this.craft[id] ??= this.make(id, state));
        one.marker.setLatLng(at(state));
        const arrow = one.marker.getElement()?.querySelector("svg");
        if (arrow) {
          arrow.style.transform = `rotate(${state.heading_deg ?? 0}deg)`;
          arrow.dataset.selected = id === mavgate.selected;
          arrow.dataset.origin = state.origin;
        }
        this.draw_track(id, one);
      }
      for (const [id, one] of Object.entries(this.craft)) {
        if (id in mavgate.vehicles) continue;
        for (const layer of [one.marker, one.track, one.fixes]) layer.remove();
        delete this.craft[id];
      }
      const drawn = Object.keys(this.craft).map((id) => mavgate.vehicles[id]);
      const paths = Object.values(ORIGINS).filter(([look]) => drawn.some((state) => look_of(state) === look));
      if (String(paths) !== String(this.paths)) this.paths = paths;
      this.has_fixes = Object.values(this.craft).some((one) => one.dots > 0);
      if (this.units !== mavgate.units) {
        this.units = mavgate.units;
        this.scale._update();
        this.grid.draw();
      }
      this.draw_selected(mavgate.state);
    },
    draw_selected(state) {
      if (!state || state.lat_deg === null) return;
      const here = at(state);
      this.toggle(this.home, state.home, () => this.home.setLatLng(at(state.home)));
      // The direction of an antenna at home.
      this.toggle(this.antenna, state.home, () => this.antenna.setLatLngs([at(state.home), here]));
      this.sight = state.home ? `from home ${Math.round(mavgate.bearing_deg(at(state.home), here)) % 360}°` : "";
      const origin = state.home ? at(state.home) : (this.grid.origin ?? here);
      if (String(origin) !== String(this.grid.origin)) {
        this.grid.origin = origin;
        this.grid.draw();
      }
      this.toggle(this.mark, state.mark, () => this.mark.setLatLng(at(state.mark)));
      this.toggle(this.bearing, state.mark, () => this.bearing.setLatLngs([here, at(state.mark)]));
      const radius = state.pos_std_m === null ? null : CIRCLE_95 * state.pos_std_m;
      this.toggle(this.accuracy, radius !== null, () => this.accuracy.setLatLng(here).setRadius(radius));
      this.circle = radius === null ? "" : mavgate.show("length", radius).join(" ");
      this.way = "";
      if (state.mark) {
        const distance = mavgate.distance_m(here, at(state.mark));
        const bearing = mavgate.bearing_deg(here, at(state.mark));
        this.way = `mark ${mavgate.show("distance", distance, 2).join(" ")}, ${Math.round(bearing) % 360}°`;
      }
      this.position = `${state.lat_deg.toFixed(6)}, ${state.lon_deg.toFixed(6)}`;
      if (!this.placed) {
        this.placed = true;
        this.map.setView(here, 17, { animate: false });
      } else if (this.follow) {
        this.map.panTo(here, { animate: false });
      }
    },
    toggle(layer, shown, place) {
      if (shown) {
        place();
        if (!this.map.hasLayer(layer)) layer.addTo(this.map);
      } else if (layer && this.map.hasLayer(layer)) {
        layer.remove();
      }
    },
    fit() {
      this.follow = false;
      const tracks = Object.values(this.craft).map((one) => one.track.getBounds());
      const all = tracks.reduce((sum, bounds) => sum.extend(bounds), L.latLngBounds([]));
      if (all.isValid()) this.map.fitBounds(all.pad(0.1));
    },
    locate() {
      if (!this.entered) return;
      this.follow = false;
      this.located ??= L.circleMarker([0, 0], { radius: 9, weight: 2, fill: false, interactive: false });
      this.located.setStyle({ color: this.mark_colour }).setLatLng(at(this.entered)).addTo(this.map);
      this.map.setView(at(this.entered), Math.max(this.map.getZoom(), 15), { animate: false });
    },
    // Show the possible actions next to a position.
    ask(spot) {
      const state = mavgate.state;
      if (!state) return;
      this.asked = { ...spot, text: `${spot.lat_deg.toFixed(6)}, ${spot.lon_deg.toFixed(6)}`, title: state.title, has_mark: Boolean(state.mark), style: {} };
      this.place_question();
      this.$nextTick(() => this.$refs.ask?.querySelector("button").focus({ preventScroll: true }));
    },
    place_question() {
      const { x, y } = this.map.latLngToContainerPoint(at(this.asked));
      const { x: width, y: height } = this.map.getSize();
      const side = x > width / 2 ? { right: `${width - x + 12}px` } : { left: `${x + 12}px` };
      this.asked.style = { ...side, ...(y > height / 2 ? { bottom: `${height - y - 12}px` } : { top: `${y - 12}px` }) };
    },
    act(what) {
      this.$emit(what, { lat_deg: this.asked.lat_deg, lon_deg: this.asked.lon_deg });
      this.asked = null;
    },
    clear() {
      mavgate.clear_tracks();
      this.stale = true;
    },
    async copy() {
      try {
        await navigator.clipboard.writeText(this.position);
      } catch {
        // Without TLS a browser allows copying only from a selection.
        const box = Object.assign(document.createElement("textarea"), { value: this.position });
        document.body.append(box);
        box.select();
        document.execCommand("copy");
        box.remove();
      }
      this.copied = true;
      setTimeout(() => (this.copied = false), 1500);
    },
  },
};
