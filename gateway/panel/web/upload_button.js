// SPDX-License-Identifier: Apache-2.0
// Brings a recording from the browser's machine, as a plain PUT that can be watched.
export default {
  template: `
    <label class="upload"><input type="file" accept=".tlog,.csv" @change="choose" aria-label="Bring a recording">
      <span>{{ word }}</span></label>`,
  props: { limit: Number },
  data: () => ({ word: "Upload…" }),
  methods: {
    choose(event) {
      const file = event.target.files[0];
      event.target.value = "";
      if (!file) return;
      if (file.size > this.limit) {
        this.$emit("uploaded", { ok: false, text: `${file.name} is too large: at most ${Math.round(this.limit / 1e6)} MB` });
        return;
      }
      const name = file.name.replace(/(_\d{2,})?(_v\d+)?\.(tlog|csv)$/i, "");
      const request = new XMLHttpRequest();
      request.upload.onprogress = (step) => (this.word = `${Math.round((100 * step.loaded) / step.total)} %`);
      request.onloadend = () => {
        this.word = "Upload…";
        const ok = request.status === 201;
        this.$emit("uploaded", { ok, text: ok ? `${name} was uploaded` : request.responseText || "the upload was interrupted" });
      };
      request.open("PUT", `/recordings/${encodeURIComponent(name)}`);
      request.send(file);
    },
  },
};
