// SPDX-License-Identifier: Apache-2.0
// A table of texts. Rows keep their elements while their key stays. If a table of many columns is
// too wide, each row is a block with the name of the column before each cell.
export default {
  template: `
    <div class="table-frame" tabindex="0">
      <table class="table" :class="{ many: columns.length > 4, most: columns.length > 7 }">
        <thead><tr>
          <th v-for="column in columns" scope="col">{{ column }}</th>
          <td v-if="buttons.length"></td>
        </tr></thead>
        <tbody><tr v-for="row in rows" :key="row.key" :data-key="row.key">
          <td v-for="([text, look, icon, track], n) in row.cells" :data-column="columns[n]"><svg v-if="track" class="thumbnail" viewBox="0 0 46 24" aria-hidden="true"><polyline :points="track" /></svg><span :class="look"><i v-if="icon" class="q-icon material-icons" aria-hidden="true">{{ icon }}</i>{{ text }}</span></td>
          <td v-if="buttons.length" class="acts">
            <button v-for="([icon, title], n) in buttons" type="button" class="row-button" :title="title" :aria-label="title" @click="$emit('act', n, row.key)"><i class="q-icon material-icons" aria-hidden="true">{{ icon }}</i></button>
          </td>
        </tr></tbody>
      </table>
      <p v-if="!rows.length && empty" class="soft nothing">{{ empty }}</p>
    </div>`,
  props: { columns: Array, rows: Array, buttons: Array, empty: String },
};
