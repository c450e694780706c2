// SPDX-License-Identifier: Apache-2.0
// Uploads a file by a plain PUT, whose progress can be shown.
export default {
  template: `
    <label class="upload"><input type="file" :accept="accept" @change="choose" :aria-label="title">
      <span>{{ progress || label }}</span></label>`,
  props: { limit: Number, path: String, accept: String, label: String, title: String },
  data: () => ({ progress: "" }),
  methods: {
    choose(event) {
      const file = event.target.files[0];
      event.target.value = "";
      if (!file) return;
      if (file.size > this.limit) {
        this.$emit("uploaded", { ok: false, text: `${file.name} is too large: at most ${Math.round(this.limit / 1e6)} MB` });
        return;
      }
      const name = file.name.replace(/(_\d{2,})?(_v\d+)?\.(tlog|csv)$|\.pmtiles$/i, "");
      const request = new XMLHttpRequest();
      request.upload.onprogress = (step) => (this.progress = `${Math.round((100 * step.loaded) / step.total)} %`);
      request.onloadend = () => {
        this.progress = "";
        const ok = request.status === 201;
        this.$emit("uploaded", { ok, text: ok ? `${name} was uploaded` : request.responseText || "the upload was interrupted" });
      };
      request.open("PUT", `${this.path}${encodeURIComponent(name)}`);
      request.send(file);
    },
  },
};
