// SPDX-License-Identifier: Apache-2.0
// The choice of views, and the page's keys. Views change here at once; the server builds a view
// when it is shown for the first time.
const FIRST = 5; // views that a narrow screen shows; the others are under "More"
const TYPING = "input, select, textarea, [contenteditable=true]";

export default {
  template: `
    <nav class="rail" aria-label="Views" :data-open="open" @keydown.esc="open = false">
      <button v-for="(view, n) in views" :key="view.key" type="button" :data-view="view.key" :aria-label="view.title" :class="{ extra: n >= first }"
        :style="{ '--place': views.length - n - 1 }"
        :aria-current="view.key === current ? 'page' : 'false'" :aria-keyshortcuts="n < 9 ? n + 1 : null" @click="show(view.key)">
        <i class="q-icon material-icons" aria-hidden="true">{{ view.icon }}</i><span>{{ view.title }}</span>
      </button>
      <button type="button" class="more" :aria-expanded="open" :data-current="views.findIndex(({ key }) => key === current) >= first" @click="open = !open">
        <i class="q-icon material-icons" aria-hidden="true">more_horiz</i><span>More</span>
      </button>
    </nav>`,
  props: { views: Array, units: String, system_id: Number, page: String },
  data() {
    return { current: this.views[0].key, first: FIRST, open: false };
  },
  mounted() {
    mavgate.connect(this.page);
    this.$watch("units", (units) => (mavgate.units = units), { immediate: true });
    this.$watch("system_id", (id) => mavgate.select(id ?? null), { immediate: true });
    this.on_key = (event) => this.key(event);
    document.addEventListener("keydown", this.on_key);
    this.on_press = (event) => this.$el.contains(event.target) || (this.open = false);
    document.addEventListener("pointerdown", this.on_press);
    this.reveal();
  },
  unmounted() {
    document.removeEventListener("keydown", this.on_key);
    document.removeEventListener("pointerdown", this.on_press);
  },
  methods: {
    show(key) {
      this.open = false;
      if (key === this.current) return;
      this.current = key;
      this.reveal();
      this.$emit("show", key);
    },
    reveal() {
      for (const section of document.querySelectorAll(".stage > .view")) section.hidden = section.dataset.view !== this.current;
    },
    key(event) {
      if (event.repeat || event.ctrlKey || event.altKey || event.metaKey || event.target.closest?.(TYPING)) return;
      const view = this.views[Number(event.key) - 1];
      if (view) this.show(view.key);
      else if (event.key === "t") this.$emit("theme");
      else if (event.key === " " && !event.target.closest?.("button")) {
        event.preventDefault();
        this.$emit("toggle");
      }
    },
  },
};
