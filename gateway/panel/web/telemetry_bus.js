// SPDX-License-Identifier: Apache-2.0
// The page's telemetry: one WebSocket, the newest state of every aircraft, and who wants to know.
(() => {
  const FACTORS = {
    metric: { speed: [1, "m/s"], altitude: [1, "m"], climb: [1, "m/s"], length: [1, "m"], distance: [1000, "km"] },
    imperial: { speed: [0.44704, "mph"], altitude: [0.3048, "ft"], climb: [0.3048, "ft/s"], length: [0.3048, "ft"], distance: [1609.344, "mi"] },
    aviation: { speed: [1852 / 3600, "kt"], altitude: [0.3048, "ft"], climb: [0.3048 / 60, "ft/min"], length: [0.3048, "ft"], distance: [1852, "NM"] },
  };
  const FAR_M = 1000;
  const subscribers = new Set();

  const bus = {
    vehicles: {},
    state: null,
    selected: null,
    units: "metric",
    connected: false,
    received_ms: 0,

    subscribe(callback) {
      subscribers.add(callback);
      if (bus.state) callback(bus.state);
      return () => subscribers.delete(callback);
    },
    select(system_id) {
      bus.selected = system_id === null ? null : String(system_id);
      bus.state = bus.vehicles[bus.selected] ?? null;
      publish();
    },
    // Value of SI in the page's units: [text, unit].
    show(quantity, value, digits = 1) {
      if (!Number.isFinite(value)) return ["—", FACTORS[bus.units][quantity][1]];
      if (quantity === "distance" && Math.abs(value) < FAR_M) [quantity, digits] = ["length", 0];
      const [factor, unit] = FACTORS[bus.units][quantity];
      return [(value / factor).toFixed(digits), unit];
    },
    factor: (quantity) => FACTORS[bus.units][quantity][0],
    // A colour of the style sheet, as canvas and WebGL want it.
    colour: (name) => getComputedStyle(document.body).getPropertyValue(`--${name}`).trim(),
    // Calls back when the page turns dark or light, not when another class of its body is set again.
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
  };
  window.mavgate = bus;

  function publish() {
    for (const callback of subscribers) {
      try {
        callback(bus.state);
      } catch (error) {
        console.error(error);
      }
    }
  }

  let wait_ms = 250;
  function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/telemetry`);
    socket.onopen = () => {
      wait_ms = 250;
      bus.connected = true;
    };
    socket.onmessage = (event) => {
      const news = JSON.parse(event.data);
      bus.vehicles = news.vehicles;
      bus.received_ms = performance.now();
      bus.state = bus.vehicles[bus.selected] ?? null;
      publish();
      if (socket.readyState === WebSocket.OPEN) socket.send("1");
    };
    socket.onclose = () => {
      bus.connected = false;
      setTimeout(connect, wait_ms);
      wait_ms = Math.min(wait_ms * 2, 4000);
    };
  }
  connect();
})();
