// SPDX-License-Identifier: Apache-2.0
// The flight in numbers: each with its unit, and its age if it is old.
const OLD_S = 1.5;
const EVERY_MS = 50;
const rad = Math.PI / 180;
const EARTH_M = 6371000;
const LEAST_SIGHT_M = 3; // an error of the position of that size turns the direction by a radian

export default {
  template: `
    <dl class="number-strip" aria-label="Flight in numbers">
      <div v-for="item in items" :key="item.name" :class="{ old: item.age_s > limit, wide: item.is_wide }" :data-item="item.name">
        <dt>{{ item.name }} <span v-if="item.age_s > limit" class="age">{{ Math.round(item.age_s) }} s old</span></dt>
        <dd><b>{{ item.text }}</b> <span class="unit">{{ item.unit }}</span></dd>
      </div>
    </dl>`,
  data: () => ({ items: [], limit: OLD_S }),
  mounted() {
    let updated_ms = 0;
    const update = () => {
      this.timer = undefined;
      updated_ms = performance.now();
      this.items = mavgate.state ? items_of(displayed(mavgate.state)) : [];
    };
    // The flight display calls this after each of its frames, so that both show one moment.
    mavgate.show_numbers = () => performance.now() - updated_ms >= EVERY_MS && update();
    // At most that often, and always once after the last change.
    this.stop = mavgate.subscribe(() => (this.timer ??= setTimeout(update, EVERY_MS)));
  },
  unmounted() {
    this.stop?.();
    mavgate.show_numbers = null;
    clearTimeout(this.timer);
  },
};

// The state with the attitude, speeds and heights that the flight display shows.
function displayed(state) {
  const shown = mavgate.displayed;
  return shown?.fresh === state.system_id ? { ...state, ...shown, q_nb: shown.q ?? state.q_nb } : state;
}

function items_of(state) {
  const past = mavgate.past_us !== null;
  const age = (name) => (past ? 0 : (state[name] ?? 0));
  const q = state.q_nb;
  const angles = q && q[0] !== null ? mavgate.euler_deg(q) : [null, null, null];
  const angle = (value, digits = 1) => (Number.isFinite(value) ? value.toFixed(digits) : "—");
  const heading = Number.isFinite(angles[2]) ? angles[2] : state.heading_deg;
  const here = [state.lat_deg, state.lon_deg];
  const item = (name, text, unit, age_name) => ({ name, text, unit, age_s: age(age_name) });
  // Latitude and longitude are one item, without a line break between them.
  const position = (name, lat, lon) => ({ ...item(name, Number.isFinite(lat) ? `${lat.toFixed(6)}, ${lon.toFixed(6)}` : "—", "°", "position_s"), is_wide: true });
  const quantity = (name, kind, value, age_name, digits = 1) => item(name, ...mavgate.show(kind, value, digits), age_name);
  const way = (name, spot) => {
    if (!spot || !Number.isFinite(here[0])) return [];
    const to = [spot.lat_deg, spot.lon_deg];
    const [text, unit] = mavgate.show("distance", mavgate.distance_m(here, to), 2);
    const bearing = Math.round(mavgate.bearing_deg(here, to)) % 360;
    return [item(name, text, `${unit} ${bearing}°`, "position_s")];
  };
  // Direction of an antenna at home; the Earth's curvature lowers the line by half the arc.
  const sight = (home) => {
    const rise_m = state.alt_amsl_m - home?.alt_amsl_m;
    if (!Number.isFinite(rise_m) || !Number.isFinite(here[0]) || home.alt_amsl_m === null || state.alt_amsl_m === null) return [];
    const from = [home.lat_deg, home.lon_deg];
    const distance_m = mavgate.distance_m(from, here);
    // Directly above home the direction is unknown.
    if (distance_m < LEAST_SIGHT_M) return [item("From home", "—", "", "position_s")];
    const elevation = (Math.atan2(rise_m, distance_m) - distance_m / 2 / EARTH_M) / rad;
    return [item("From home", `${Math.round(mavgate.bearing_deg(from, here)) % 360}°`, `${elevation.toFixed(1)}°↑`, "position_s")];
  };
  return [
    item("Roll", angle(angles[0]), "°", "attitude_s"),
    item("Pitch", angle(angles[1]), "°", "attitude_s"),
    item("Heading", angle(heading, 0), "°", "attitude_s"),
    quantity("Ground speed", "speed", state.groundspeed_mps, "hud_s"),
    quantity("Climb", "climb", state.climb_mps, "hud_s"),
    quantity("Above home", "altitude", state.alt_home_m, "position_s"),
    quantity("Above sea", "altitude", state.alt_amsl_m, "position_s"),
    ...way("To home", state.home),
    ...sight(state.home),
    ...way("To mark", state.mark),
    position("Latitude, longitude", ...here),
    ...(state.mark ? [position("Mark at", state.mark.lat_deg, state.mark.lon_deg)] : []),
    item("Satellites", state.fix_type ? angle(state.satellites, 0) : "—", "", "gps_s"),
    ...(Number.isFinite(state.battery_v) ? [item(state.battery_name ?? "Battery", state.battery_v.toFixed(2), Number.isFinite(state.battery_percent) ? `V ${Math.round(state.battery_percent)} %` : "V", "battery_s")] : []),
  ];
}
