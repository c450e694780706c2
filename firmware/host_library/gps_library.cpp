// SPDX-License-Identifier: Apache-2.0
// The GPS parsers as a shared library, so that the Python tests can hold them against other parsers.
#include <cstring>

#include "common/nmea.h"
#include "common/ubx.h"

namespace {

void append(WireHeader *header, uint8_t kind, const void *payload, uint8_t *out) {
    *header = WireHeader{wire_version_kind(kind), wire_vehicle_node(1, 1), 0, 0};
    std::memcpy(out, payload, WIRE_MAX_PAYLOAD);
}

}  // namespace

// Parses `data` as the GPS node would. Writes each solution's two payloads, fix and quality, to
// `out`, which has room for `capacity` solutions of 64 bytes. Returns the number of solutions.
extern "C" uint32_t gps_parse(const uint8_t *data, uint32_t size, uint8_t *out, uint32_t capacity) {
    UbxReader ubx = {};
    UbxParts parts = {};
    NmeaReader nmea;
    NmeaEpoch epoch;
    nmea_start(&nmea, &epoch);
    WireGpsFix fix = {};
    WireGpsQuality quality = {};
    uint32_t solutions = 0;
    for (uint32_t i = 0; i < size && solutions < capacity; ++i) {
        bool complete = false;
        if (ubx_read(&ubx, data[i])) {
            if (ubx.id == UBX_NAV_PVT && ubx.size == UBX_NAV_PVT_SIZE) {
                ubx_to_fix(ubx.payload, &fix);
                ubx_to_quality(ubx.payload, &quality);
                complete = true;
            } else {
                complete = ubx_take_part(&parts, &ubx, i, &fix, &quality);
            }
        }
        if (nmea_read(&nmea, data[i])) {
            complete = nmea_join(&epoch, &nmea, i, &fix, &quality) || complete;
        }
        if (complete) {
            append(&fix.header, WIRE_GPS_FIX, &fix, out + 64 * solutions);
            append(&quality.header, WIRE_GPS_QUALITY, &quality, out + 64 * solutions + 32);
            ++solutions;
        }
    }
    return solutions;
}
