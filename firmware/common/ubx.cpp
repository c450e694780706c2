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
            reader->size = static_cast<uint16_t>(reader->size | byte << 8);
            if (reader->size > UBX_SIZE_MAX) {
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

// u-blox 6 receiver description, sections 35.15.5, .8, .11 and .14.
constexpr uint8_t POSLLH_SIZE = 28;
constexpr uint8_t SOL_SIZE = 52;
constexpr uint8_t VELNED_SIZE = 36;
constexpr uint8_t TIMEUTC_SIZE = 20;

enum Part : uint8_t { PART_POSLLH = 1, PART_SOL = 2, PART_VELNED = 4, PART_TIMEUTC = 8, ALL_PARTS = 15 };

enum OldOffset : uint8_t {
    POSLLH_LON = 4,
    POSLLH_LAT = 8,
    POSLLH_HEIGHT = 12,
    POSLLH_HEIGHT_MSL = 16,
    POSLLH_H_ACC = 20,
    POSLLH_V_ACC = 24,
    SOL_FIX_TYPE = 10,
    SOL_FLAGS = 11,
    SOL_PDOP = 44,
    SOL_SATELLITES = 47,
    VELNED_VEL_N = 4,  // cm/s
    VELNED_S_ACC = 28,
    VELNED_HEAD_ACC = 32,
    TIMEUTC_NANO = 8,
    TIMEUTC_YEAR = 12,
    TIMEUTC_VALID = 19,
};

constexpr uint8_t TIMEUTC_VALID_UTC = 1 << 2;

// hwVersion in UBX-MON-VER: "00040007" in a u-blox 6, "000A0000" in a u-blox 10.
constexpr uint8_t MON_VER_HARDWARE = 30;

constexpr uint8_t VALID_DATE_TIME_RESOLVED = 0x07;
constexpr uint8_t FLAG_FIX_OK = 0x01;
constexpr uint8_t FIX_TYPE_MAX = 5;
constexpr uint8_t LEAP_SECOND = 60;
constexpr uint16_t CENTURY = 2000;
constexpr int32_t NANO_PER_HUNDREDTH = 10000000;

// A fix type that this protocol does not know is no fix.
uint8_t fix_byte(uint8_t type, uint8_t flags) {
    const uint8_t known = type > FIX_TYPE_MAX ? 0 : type;
    return static_cast<uint8_t>(known | ((flags & FLAG_FIX_OK) != 0 ? 0x80 : 0));
}

int16_t geoid_cm(int32_t ellipsoid_mm, int32_t msl_mm) {
    const int64_t geoid_mm = static_cast<int64_t>(ellipsoid_mm) - msl_mm;
    return clamp_geoid(static_cast<int32_t>(geoid_mm));
}

// `clock`: year, month, day, hour, minute and second, as both messages have them.
void fill_time(bool valid, const uint8_t *clock, int32_t nano, WireGpsQuality *quality) {
    const uint16_t year = load<uint16_t>(clock);
    memset(&quality->time_valid, 0, 8);
    if (!valid || clock[6] >= LEAP_SECOND || year < CENTURY || year > CENTURY + UINT8_MAX) {
        return;
    }
    quality->time_valid = 1;
    quality->year = static_cast<uint8_t>(year - CENTURY);
    quality->month = clock[2];
    quality->day = clock[3];
    quality->hour = clock[4];
    quality->minute = clock[5];
    quality->second = clock[6];
    // The receiver rounds the second to the nearest hundredth, so nano may be down to -5 ms.
    quality->hundredths = static_cast<uint8_t>(nano < 0 ? 0 : nano / NANO_PER_HUNDREDTH);
}

void take_posllh(const uint8_t *payload, WireGpsFix *fix, WireGpsQuality *quality) {
    fix->lat_dege7 = load<int32_t>(payload + POSLLH_LAT);
    fix->lon_dege7 = load<int32_t>(payload + POSLLH_LON);
    fix->alt_amsl_mm = load<int32_t>(payload + POSLLH_HEIGHT_MSL);
    quality->h_acc_cm = clamp_accuracy(load<uint32_t>(payload + POSLLH_H_ACC), 10);
    quality->v_acc_cm = clamp_accuracy(load<uint32_t>(payload + POSLLH_V_ACC), 10);
    quality->geoid_separation_cm = geoid_cm(load<int32_t>(payload + POSLLH_HEIGHT), fix->alt_amsl_mm);
}

void take_velned(const uint8_t *payload, WireGpsFix *fix, WireGpsQuality *quality) {
    for (uint8_t axis = 0; axis < 3; ++axis) {
        const int32_t cmps = load<int32_t>(payload + VELNED_VEL_N + 4 * axis);
        fix->vel_n_cmps[axis] = clamp_velocity(cmps > INT32_MAX / 10   ? INT32_MAX
                                               : cmps < INT32_MIN / 10 ? INT32_MIN
                                                                       : cmps * 10);
    }
    quality->speed_acc_cmps = clamp_accuracy(load<uint32_t>(payload + VELNED_S_ACC), 1);
    quality->course_acc_cdeg = clamp_accuracy(load<uint32_t>(payload + VELNED_HEAD_ACC), 1000);
}

// The bit of a message among the parts of a solution, 0 if it is none of them.
uint8_t part_of(const UbxReader *reader) {
    switch (reader->id) {
        case UBX_NAV_POSLLH:
            return reader->size == POSLLH_SIZE ? PART_POSLLH : 0;
        case UBX_NAV_SOL:
            return reader->size == SOL_SIZE ? PART_SOL : 0;
        case UBX_NAV_VELNED:
            return reader->size == VELNED_SIZE ? PART_VELNED : 0;
        case UBX_NAV_TIMEUTC:
            return reader->size == TIMEUTC_SIZE ? PART_TIMEUTC : 0;
        default:
            return 0;
    }
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
            if (reader->at < sizeof reader->payload) {
                reader->payload[reader->at] = byte;
            }
            ++reader->at;
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
    fix->fix = fix_byte(nav_pvt[PVT_FIX_TYPE], nav_pvt[PVT_FLAGS]);
    fix->satellites = nav_pvt[PVT_SATELLITES];
}

void ubx_to_quality(const uint8_t *nav_pvt, WireGpsQuality *quality) {
    quality->itow_ms = load<uint32_t>(nav_pvt + PVT_ITOW);
    quality->h_acc_cm = clamp_accuracy(load<uint32_t>(nav_pvt + PVT_H_ACC), 10);
    quality->v_acc_cm = clamp_accuracy(load<uint32_t>(nav_pvt + PVT_V_ACC), 10);
    quality->speed_acc_cmps = clamp_accuracy(load<uint32_t>(nav_pvt + PVT_S_ACC), 10);
    quality->course_acc_cdeg = clamp_accuracy(load<uint32_t>(nav_pvt + PVT_HEAD_ACC), 1000);
    quality->pdop_centi = load<uint16_t>(nav_pvt + PVT_PDOP);
    quality->geoid_separation_cm = geoid_cm(load<int32_t>(nav_pvt + PVT_HEIGHT),
                                            load<int32_t>(nav_pvt + PVT_HEIGHT_MSL));
    const bool valid = (nav_pvt[PVT_VALID] & VALID_DATE_TIME_RESOLVED) == VALID_DATE_TIME_RESOLVED;
    fill_time(valid, nav_pvt + PVT_YEAR, load<int32_t>(nav_pvt + PVT_NANO), quality);
}

bool ubx_take_part(UbxParts *parts, const UbxReader *reader, uint32_t begun_us, WireGpsFix *fix,
                   WireGpsQuality *quality) {
    const uint8_t part = part_of(reader);
    if (part == 0) {
        return false;
    }
    const uint8_t *payload = reader->payload;
    const uint32_t itow_ms = load<uint32_t>(payload);
    if (itow_ms != parts->itow_ms || parts->have == 0) {
        parts->itow_ms = itow_ms;
        parts->begun_us = begun_us;
        parts->have = 0;
    }
    if (part == PART_POSLLH) {
        take_posllh(payload, fix, quality);
    } else if (part == PART_SOL) {
        fix->fix = fix_byte(payload[SOL_FIX_TYPE], payload[SOL_FLAGS]);
        fix->satellites = payload[SOL_SATELLITES];
        quality->pdop_centi = load<uint16_t>(payload + SOL_PDOP);
    } else if (part == PART_VELNED) {
        take_velned(payload, fix, quality);
    } else {
        fill_time((payload[TIMEUTC_VALID] & TIMEUTC_VALID_UTC) != 0, payload + TIMEUTC_YEAR,
                  load<int32_t>(payload + TIMEUTC_NANO), quality);
    }
    parts->have = static_cast<uint8_t>(parts->have | part);
    if (parts->have != ALL_PARTS) {
        return false;
    }
    parts->have = 0;
    fix->itow_ms = quality->itow_ms = itow_ms;
    return true;
}

uint8_t ubx_generation(const UbxReader *reader) {
    if (reader->id != UBX_MON_VER || reader->size < MON_VER_HARDWARE + 8) {
        return 0;
    }
    const uint8_t *version = reader->payload + MON_VER_HARDWARE;
    if (version[0] != '0' || version[1] != '0') {
        return 0;
    }
    switch (version[2] << 8 | version[3]) {
        case '0' << 8 | '4':
            return 6;
        case '0' << 8 | '7':
            return 7;
        case '0' << 8 | '8':
            return 8;
        case '1' << 8 | '9':
            return 9;
        case '0' << 8 | 'A':
            return 10;
        default:
            return 0;
    }
}
