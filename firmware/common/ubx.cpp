// SPDX-License-Identifier: Apache-2.0
#include "common/ubx.h"

#include <string.h>

namespace {

enum State : uint8_t { SYNC_1, SYNC_2, CLASS, ID, LENGTH_LOW, LENGTH_HIGH, PAYLOAD, CHECK_A, CHECK_B };

void sum(UbxReader *reader, uint8_t byte) {
    reader->check_a = static_cast<uint8_t>(reader->check_a + byte);
    reader->check_b = static_cast<uint8_t>(reader->check_b + reader->check_a);
}

void fail(UbxReader *reader, uint8_t byte) {
    ++reader->errors;
    reader->state = byte == UBX_SYNC_1 ? SYNC_2 : SYNC_1;
}

// The header's bytes, all of them summed; returns the next state.
void read_header(UbxReader *reader, uint8_t byte) {
    sum(reader, byte);
    switch (reader->state) {
        case CLASS:
            reader->id = static_cast<uint16_t>(byte << 8);
            break;
        case ID:
            reader->id = static_cast<uint16_t>(reader->id | byte);
            break;
        case LENGTH_LOW:
            reader->size = byte;
            break;
        default:
            if (byte != 0 || reader->size > sizeof reader->payload) {
                fail(reader, byte);
                return;
            }
            reader->at = 0;
            reader->state = reader->size == 0 ? CHECK_A : PAYLOAD;
            return;
    }
    ++reader->state;
}

bool read_checksum(UbxReader *reader, uint8_t byte) {
    const bool first = reader->state == CHECK_A;
    if (byte != (first ? reader->check_a : reader->check_b)) {
        fail(reader, byte);
        return false;
    }
    reader->state = first ? CHECK_B : SYNC_1;
    return !first;
}

template <typename T>
T load(const uint8_t *from) {
    T value;
    memcpy(&value, from, sizeof value);
    return value;
}

int16_t clamp_velocity(int32_t mmps) {
    const int32_t cmps = mmps / 10;
    if (cmps > INT16_MAX) {
        return INT16_MAX;
    }
    return cmps < -INT16_MAX ? static_cast<int16_t>(-INT16_MAX) : static_cast<int16_t>(cmps);
}

uint16_t clamp_accuracy(uint32_t value, uint16_t divisor) {
    // Rounded up: an accuracy is a promise.
    const uint32_t scaled = value / divisor + (value % divisor != 0 ? 1 : 0);
    return scaled > UINT16_MAX ? UINT16_MAX : static_cast<uint16_t>(scaled);
}

int16_t clamp_geoid(int32_t mm) {
    const int32_t cm = mm / 10;
    if (cm > INT16_MAX) {
        return INT16_MAX;
    }
    return cm < INT16_MIN ? static_cast<int16_t>(INT16_MIN) : static_cast<int16_t>(cm);
}

// Offsets of UBX-NAV-PVT, u-blox 8 / M8 receiver description, section 32.17.15.
enum NavPvt : uint8_t {
    PVT_ITOW = 0,
    PVT_YEAR = 4,
    PVT_MONTH = 6,
    PVT_DAY = 7,
    PVT_HOUR = 8,
    PVT_MINUTE = 9,
    PVT_SECOND = 10,
    PVT_VALID = 11,
    PVT_NANO = 16,
    PVT_FIX_TYPE = 20,
    PVT_FLAGS = 21,
    PVT_SATELLITES = 23,
    PVT_LON = 24,
    PVT_LAT = 28,
    PVT_HEIGHT = 32,
    PVT_HEIGHT_MSL = 36,
    PVT_H_ACC = 40,
    PVT_V_ACC = 44,
    PVT_VEL_N = 48,
    PVT_S_ACC = 68,
    PVT_HEAD_ACC = 72,
    PVT_PDOP = 76,
};

constexpr uint8_t VALID_DATE_TIME_RESOLVED = 0x07;
constexpr uint8_t FLAG_FIX_OK = 0x01;
constexpr uint8_t FIX_TYPE_MAX = 5;
constexpr uint8_t LEAP_SECOND = 60;
constexpr uint16_t CENTURY = 2000;
constexpr int32_t NANO_PER_HUNDREDTH = 10000000;

bool time_is_valid(const uint8_t *nav_pvt) {
    const uint16_t year = load<uint16_t>(nav_pvt + PVT_YEAR);
    return (nav_pvt[PVT_VALID] & VALID_DATE_TIME_RESOLVED) == VALID_DATE_TIME_RESOLVED &&
           nav_pvt[PVT_SECOND] < LEAP_SECOND && year >= CENTURY && year <= CENTURY + UINT8_MAX;
}

}  // namespace

bool ubx_read(UbxReader *reader, uint8_t byte) {
    switch (reader->state) {
        case SYNC_1:
            reader->state = byte == UBX_SYNC_1 ? SYNC_2 : SYNC_1;
            return false;
        case SYNC_2:
            if (byte != UBX_SYNC_1) {
                reader->state = byte == UBX_SYNC_2 ? CLASS : SYNC_1;
            }
            reader->check_a = reader->check_b = 0;
            return false;
        case PAYLOAD:
            sum(reader, byte);
            reader->payload[reader->at++] = byte;
            if (reader->at == reader->size) {
                reader->state = CHECK_A;
            }
            return false;
        case CHECK_A:
        case CHECK_B:
            return read_checksum(reader, byte);
        default:
            read_header(reader, byte);
            return false;
    }
}

bool ubx_begun(const UbxReader *reader) { return reader->state == SYNC_2; }

void ubx_cut(UbxReader *reader) {
    if (reader->state != SYNC_1) {
        fail(reader, 0);
    }
}

uint8_t ubx_write(uint16_t id, const uint8_t *payload, uint8_t size, uint8_t *out) {
    out[0] = UBX_SYNC_1;
    out[1] = UBX_SYNC_2;
    out[2] = static_cast<uint8_t>(id >> 8);
    out[3] = static_cast<uint8_t>(id);
    out[4] = size;
    out[5] = 0;
    memcpy(out + 6, payload, size);
    uint8_t check_a = 0;
    uint8_t check_b = 0;
    for (uint8_t i = 2; i < size + 6; ++i) {
        check_a = static_cast<uint8_t>(check_a + out[i]);
        check_b = static_cast<uint8_t>(check_b + check_a);
    }
    out[size + 6] = check_a;
    out[size + 7] = check_b;
    return static_cast<uint8_t>(size + UBX_OVERHEAD);
}

void ubx_to_fix(const uint8_t *nav_pvt, WireGpsFix *fix) {
    fix->itow_ms = load<uint32_t>(nav_pvt + PVT_ITOW);
    fix->lat_dege7 = load<int32_t>(nav_pvt + PVT_LAT);
    fix->lon_dege7 = load<int32_t>(nav_pvt + PVT_LON);
    fix->alt_amsl_mm = load<int32_t>(nav_pvt + PVT_HEIGHT_MSL);
    for (uint8_t axis = 0; axis < 3; ++axis) {
        fix->vel_n_cmps[axis] = clamp_velocity(load<int32_t>(nav_pvt + PVT_VEL_N + 4 * axis));
    }
    // A fix type that this protocol does not know is no fix.
    const uint8_t type = nav_pvt[PVT_FIX_TYPE] > FIX_TYPE_MAX ? 0 : nav_pvt[PVT_FIX_TYPE];
    const uint8_t ok = (nav_pvt[PVT_FLAGS] & FLAG_FIX_OK) != 0 ? 0x80 : 0;
    fix->fix = static_cast<uint8_t>(type | ok);
    fix->satellites = nav_pvt[PVT_SATELLITES];
}

void ubx_to_quality(const uint8_t *nav_pvt, WireGpsQuality *quality) {
    quality->itow_ms = load<uint32_t>(nav_pvt + PVT_ITOW);
    quality->h_acc_cm = clamp_accuracy(load<uint32_t>(nav_pvt + PVT_H_ACC), 10);
    quality->v_acc_cm = clamp_accuracy(load<uint32_t>(nav_pvt + PVT_V_ACC), 10);
    quality->speed_acc_cmps = clamp_accuracy(load<uint32_t>(nav_pvt + PVT_S_ACC), 10);
    quality->course_acc_cdeg = clamp_accuracy(load<uint32_t>(nav_pvt + PVT_HEAD_ACC), 1000);
    quality->pdop_centi = load<uint16_t>(nav_pvt + PVT_PDOP);
    const int32_t ellipsoid_mm = load<int32_t>(nav_pvt + PVT_HEIGHT);
    const int64_t geoid_mm = static_cast<int64_t>(ellipsoid_mm) - load<int32_t>(nav_pvt + PVT_HEIGHT_MSL);
    quality->geoid_separation_cm = clamp_geoid(static_cast<int32_t>(geoid_mm));
    memset(&quality->time_valid, 0, 8);
    if (!time_is_valid(nav_pvt)) {
        return;
    }
    const int32_t nano = load<int32_t>(nav_pvt + PVT_NANO);
    quality->time_valid = 1;
    quality->year = static_cast<uint8_t>(load<uint16_t>(nav_pvt + PVT_YEAR) - CENTURY);
    quality->month = nav_pvt[PVT_MONTH];
    quality->day = nav_pvt[PVT_DAY];
    quality->hour = nav_pvt[PVT_HOUR];
    quality->minute = nav_pvt[PVT_MINUTE];
    quality->second = nav_pvt[PVT_SECOND];
    // The receiver rounds the second to the nearest hundredth, so nano may be down to -5 ms.
    quality->hundredths = nano < 0 ? 0 : static_cast<uint8_t>(nano / NANO_PER_HUNDREDTH);
}
