// SPDX-License-Identifier: Apache-2.0
#include "common/nmea.h"

#include <math.h>
#include <string.h>

namespace {

enum State : uint8_t { IDLE, BEGUN, BODY, CHECK_HIGH, CHECK_LOW };

constexpr uint32_t FRACTION = 10000000;  // seven decimals
constexpr uint32_t MS_PER_DAY = 86400000;
constexpr uint32_t MS_PER_MINUTE = 60000;
constexpr uint32_t LEAP_MS = 18000;  // GPS time less UTC, since 2017
constexpr float MMPS_PER_KNOT = 514.444F;
constexpr float RAD_PER_CDEG = 1.74532925e-4F;
constexpr uint16_t CENTURY = 2000;
constexpr uint16_t UNKNOWN = 0xFFFF;
constexpr uint16_t DILUTION_UNKNOWN = 9999;  // "99.99": no solution
constexpr uint32_t LONGEST_STEP_MS = 2500;   // between two fixes of one receiver
constexpr uint8_t FIX_OK = 0x80;
constexpr uint8_t FIX_NONE = 0;
constexpr uint8_t FIX_DEAD_RECKONING = 1;
constexpr uint8_t FIX_2D = 2;
constexpr uint8_t FIX_3D = 3;
constexpr uint8_t QUALITY_ESTIMATED = 6;
constexpr uint8_t SATELLITES_OF_3D = 4;

struct Number {
    bool negative;
    uint32_t whole;
    uint32_t fraction;  // over FRACTION
};

// False if the text is empty or no decimal number below 2^31.
bool read_number(const char *text, Number *number) {
    *number = Number{};
    if (*text == '-') {
        number->negative = true;
        ++text;
    }
    if (*text == 0) {
        return false;
    }
    for (; *text >= '0' && *text <= '9'; ++text) {
        if (number->whole > 200000000) {
            return false;
        }
        number->whole = number->whole * 10 + static_cast<uint8_t>(*text - '0');
    }
    if (*text == '.') {
        uint32_t unit = FRACTION;
        for (++text; *text >= '0' && *text <= '9'; ++text) {
            unit /= 10;
            number->fraction += unit * static_cast<uint8_t>(*text - '0');
        }
    }
    return *text == 0;
}

// With `scale` a power of ten up to 1000, or 0 if the field is empty, wrong or too large.
int32_t scaled(const char *text, uint32_t scale) {
    Number number;
    if (!read_number(text, &number) || number.whole > 2000000) {
        return 0;
    }
    const int32_t value = static_cast<int32_t>(number.whole * scale + number.fraction / (FRACTION / scale));
    return number.negative ? -value : value;
}

uint16_t least(uint16_t a, uint16_t b) { return a < b ? a : b; }

uint16_t dilution(const char *text) {
    const int32_t centi = scaled(text, 100);
    return centi <= 0 || centi >= DILUTION_UNKNOWN ? UNKNOWN : static_cast<uint16_t>(centi);
}

// hhmmss.sss
uint32_t time_of_day_ms(const char *text) {
    Number number;
    if (!read_number(text, &number) || number.negative || number.whole >= 240000) {
        return NMEA_NO_TIME;
    }
    const uint32_t hour = number.whole / 10000;
    const uint32_t minute = number.whole / 100 % 100;
    const uint32_t ms = number.whole % 100 * 1000 + number.fraction / (FRACTION / 1000);
    return (hour * 60 + minute) * MS_PER_MINUTE + ms;
}

// dddmm.mmmmmmm
int32_t angle_dege7(const char *text) {
    Number number;
    if (!read_number(text, &number) || number.whole > 18000) {
        return 0;
    }
    const uint32_t minutes_e7 = number.whole % 100 * FRACTION + number.fraction;
    return static_cast<int32_t>(number.whole / 100 * FRACTION + (minutes_e7 + 30) / 60);
}

uint8_t byte_of(const char *text) {
    Number number;
    return read_number(text, &number) && number.whole <= 99 ? static_cast<uint8_t>(number.whole) : 0;
}

uint8_t kind_of(const char *address) {
    // Two characters of the talker, or P and the maker: then nothing known follows.
    if (strlen(address) != 5) {
        return NMEA_OTHER;
    }
    const char *type = address + 2;
    if (strcmp(type, "RMC") == 0) {
        return NMEA_RMC;
    }
    if (strcmp(type, "GGA") == 0) {
        return NMEA_GGA;
    }
    return strcmp(type, "GSA") == 0 ? NMEA_GSA : NMEA_OTHER;
}

void take_hemisphere(const char *text, NmeaFields *fields) {
    if (*text == 'S') {
        fields->lat_dege7 = -fields->lat_dege7;
    } else if (*text == 'W') {
        fields->lon_dege7 = -fields->lon_dege7;
    }
}

void take_rmc(uint8_t field, const char *text, NmeaFields *fields) {
    switch (field) {
        case 1:
            fields->time_ms = time_of_day_ms(text);
            break;
        case 2:
            fields->quality = *text == 'A' ? 1 : 0;
            break;
        case 7: {
            Number knots;
            if (read_number(text, &knots) && knots.whole < 10000) {
                const float value = static_cast<float>(knots.whole) +
                                    static_cast<float>(knots.fraction) / static_cast<float>(FRACTION);
                fields->speed_mmps = static_cast<int32_t>(value * MMPS_PER_KNOT);
            }
            break;
        }
        case 8:
            fields->course_cdeg = scaled(text, 100);
            break;
        case 9: {
            Number date;
            fields->date = read_number(text, &date) && date.whole <= 311299 ? date.whole : 0;
            break;
        }
        default:
            break;
    }
}

void take_gga(uint8_t field, const char *text, NmeaFields *fields) {
    switch (field) {
        case 1:
            fields->time_ms = time_of_day_ms(text);
            break;
        case 2:
            fields->lat_dege7 = angle_dege7(text);
            break;
        case 4:
            fields->lon_dege7 = angle_dege7(text);
            break;
        case 3:
        case 5:
            take_hemisphere(text, fields);
            break;
        case 6:
            fields->quality = byte_of(text);
            break;
        case 7:
            fields->satellites = byte_of(text);
            break;
        case 8:
            fields->dilution[0] = dilution(text);
            break;
        case 9:
            fields->alt_amsl_mm = scaled(text, 1000);
            break;
        case 11:
            fields->geoid_mm = scaled(text, 1000);
            break;
        default:
            break;
    }
}

void take_gsa(uint8_t field, const char *text, NmeaFields *fields) {
    if (field == 2) {
        fields->quality = byte_of(text);
    } else if (field >= 15 && field <= 17) {
        fields->dilution[field - 15] = dilution(text);
    }
}

void end_field(NmeaReader *reader) {
    reader->text[reader->length] = 0;
    if (reader->field == 0) {
        reader->kind = kind_of(reader->text);
    } else if (reader->kind == NMEA_RMC) {
        take_rmc(reader->field, reader->text, &reader->fields);
    } else if (reader->kind == NMEA_GGA) {
        take_gga(reader->field, reader->text, &reader->fields);
    } else if (reader->kind == NMEA_GSA) {
        take_gsa(reader->field, reader->text, &reader->fields);
    }
    ++reader->field;
    reader->length = 0;
}

void begin(NmeaReader *reader) {
    reader->state = BEGUN;
    reader->checksum = reader->field = reader->length = 0;
    reader->kind = NMEA_OTHER;
    memset(&reader->fields, 0, sizeof reader->fields);
    reader->fields.time_ms = NMEA_NO_TIME;
    uint16_t *dilutions = reader->fields.dilution;
    dilutions[0] = dilutions[1] = dilutions[2] = UNKNOWN;
}

void read_body(NmeaReader *reader, uint8_t byte) {
    if (byte == '*') {
        end_field(reader);
        reader->state = CHECK_HIGH;
        return;
    }
    reader->state = BODY;
    reader->checksum ^= byte;
    if (byte == ',') {
        end_field(reader);
    } else if (byte < ' ' || byte > '~') {
        reader->state = IDLE;  // cut off, or no NMEA at all
    } else if (reader->length < NMEA_FIELD_SIZE - 1) {
        reader->text[reader->length++] = static_cast<char>(byte);
    }
}

uint8_t hex_digit(uint8_t byte) {
    if (byte >= '0' && byte <= '9') {
        return static_cast<uint8_t>(byte - '0');
    }
    byte |= 0x20;
    return byte >= 'a' && byte <= 'f' ? static_cast<uint8_t>(byte - 'a' + 10) : 0xFF;
}

uint8_t fix_type(const NmeaEpoch &epoch) {
    const uint8_t quality = epoch.gga.quality;
    if (epoch.rmc.quality == 0 || quality == 0) {
        return FIX_NONE;
    }
    if (quality >= QUALITY_ESTIMATED) {
        return FIX_DEAD_RECKONING;
    }
    if (epoch.gsa_type != 0) {
        return epoch.gsa_type == 3 ? FIX_3D : epoch.gsa_type == 2 ? FIX_2D : FIX_NONE;
    }
    return epoch.gga.satellites >= SATELLITES_OF_3D ? FIX_3D : FIX_2D;
}

// Days since 1 January 1970 by the civil calendar's 400-year cycle, whose months begin in March.
uint32_t days_since_1970(uint16_t year, uint8_t month, uint8_t day) {
    const uint16_t y = static_cast<uint16_t>(year - (month <= 2 ? 1 : 0));
    const uint16_t of_year =
        static_cast<uint16_t>((153U * static_cast<uint16_t>(month + (month > 2 ? -3 : 9)) + 2) / 5 + day - 1);
    const uint32_t wide = y;
    return wide * 365 + wide / 4 - wide / 100 + wide / 400 + of_year - 719468U;
}

// ms of the GPS week; without a date, of the day.
uint32_t itow_ms(const NmeaFields &rmc) {
    if (rmc.time_ms == NMEA_NO_TIME) {
        return 0;
    }
    if (rmc.date == 0) {
        return rmc.time_ms + LEAP_MS;
    }
    const uint32_t days =
        days_since_1970(static_cast<uint16_t>(CENTURY + rmc.date % 100),
                        static_cast<uint8_t>(rmc.date / 100 % 100), static_cast<uint8_t>(rmc.date / 10000));
    const uint32_t weekday = (days + 4) % 7;  // 1 January 1970 was a Thursday
    return (weekday * MS_PER_DAY + rmc.time_ms + LEAP_MS) % (7 * MS_PER_DAY);
}

uint16_t accuracy(uint16_t per_unit, uint16_t dilution_centi) {
    if (dilution_centi == UNKNOWN) {
        return UNKNOWN;
    }
    const uint32_t value = static_cast<uint32_t>(per_unit) * dilution_centi / 100;
    return value >= UNKNOWN ? UNKNOWN : static_cast<uint16_t>(value);
}

int16_t held_cmps(float mmps) {
    const float cmps = mmps / 10.0F;
    if (cmps > 32767.0F) {
        return INT16_MAX;
    }
    return cmps < -32767.0F ? static_cast<int16_t>(-INT16_MAX) : static_cast<int16_t>(lroundf(cmps));
}

// From the heights of two fixes, positive down.
int16_t vel_down_cmps(const NmeaEpoch &epoch) {
    const uint32_t step_ms = epoch.rmc.time_ms - epoch.last_ms;
    if (epoch.last_ms == NMEA_NO_TIME || step_ms == 0 || step_ms > LONGEST_STEP_MS) {
        return 0;
    }
    const float fallen_mm = static_cast<float>(epoch.last_alt_mm - epoch.gga.alt_amsl_mm);
    return held_cmps(fallen_mm * 1000.0F / static_cast<float>(step_ms));
}

void fill_fix(const NmeaEpoch &epoch, WireGpsFix *fix) {
    const uint8_t type = fix_type(epoch);
    const float course_rad = static_cast<float>(epoch.rmc.course_cdeg) * RAD_PER_CDEG;
    const float speed_mmps = static_cast<float>(epoch.rmc.speed_mmps);
    fix->itow_ms = itow_ms(epoch.rmc);
    fix->lat_dege7 = epoch.gga.lat_dege7;
    fix->lon_dege7 = epoch.gga.lon_dege7;
    fix->alt_amsl_mm = epoch.gga.alt_amsl_mm;
    fix->vel_n_cmps[0] = held_cmps(speed_mmps * cosf(course_rad));
    fix->vel_n_cmps[1] = held_cmps(speed_mmps * sinf(course_rad));
    fix->vel_n_cmps[2] = type == FIX_3D ? vel_down_cmps(epoch) : int16_t{0};
    fix->fix = type == FIX_NONE || type == FIX_DEAD_RECKONING ? type : static_cast<uint8_t>(type | FIX_OK);
    fix->satellites = epoch.gga.satellites;
}

bool date_known(const NmeaFields &rmc) {
    const uint32_t month = rmc.date / 100 % 100;
    const uint32_t day = rmc.date / 10000;
    return rmc.quality != 0 && rmc.time_ms != NMEA_NO_TIME && month >= 1 && month <= 12 && day >= 1 &&
           day <= 31;
}

void fill_time(const NmeaFields &rmc, WireGpsQuality *quality) {
    const uint32_t ms = rmc.time_ms;
    quality->time_valid = 1;
    quality->year = static_cast<uint8_t>(rmc.date % 100);
    quality->month = static_cast<uint8_t>(rmc.date / 100 % 100);
    quality->day = static_cast<uint8_t>(rmc.date / 10000);
    quality->hour = static_cast<uint8_t>(ms / 3600000);
    quality->minute = static_cast<uint8_t>(ms / 60000 % 60);
    quality->second = static_cast<uint8_t>(ms / 1000 % 60);
    quality->hundredths = static_cast<uint8_t>(ms / 10 % 100);
}

void fill_quality(const NmeaEpoch &epoch, WireGpsQuality *quality) {
    const uint16_t hdop = epoch.gga.dilution[0];
    const uint16_t vdop = epoch.vdop_centi != UNKNOWN ? epoch.vdop_centi
                          : hdop < UNKNOWN / 2        ? static_cast<uint16_t>(2 * hdop)
                                                      : UNKNOWN;
    const int32_t geoid_cm = epoch.gga.geoid_mm / 10;
    quality->itow_ms = itow_ms(epoch.rmc);
    quality->h_acc_cm = accuracy(NMEA_H_ACC_CM, hdop);
    quality->v_acc_cm = accuracy(NMEA_V_ACC_CM, vdop);
    quality->speed_acc_cmps = accuracy(NMEA_SPEED_ACC_CMPS, hdop);
    quality->course_acc_cdeg = UNKNOWN;
    quality->pdop_centi = epoch.pdop_centi != UNKNOWN ? epoch.pdop_centi : hdop;
    quality->geoid_separation_cm =
        geoid_cm > INT16_MAX || geoid_cm < INT16_MIN ? int16_t{0} : static_cast<int16_t>(geoid_cm);
    memset(&quality->time_valid, 0, 8);
    if (date_known(epoch.rmc)) {
        fill_time(epoch.rmc, quality);
    }
}

// Notes a sentence; false if its time has been delivered already.
bool note(NmeaEpoch *epoch, const NmeaReader &reader, uint32_t begun_us) {
    const NmeaFields &fields = reader.fields;
    if (fields.time_ms != NMEA_NO_TIME && fields.time_ms == epoch->delivered_ms) {
        return false;
    }
    const bool rmc = reader.kind == NMEA_RMC;
    const bool have_other = rmc ? epoch->have_gga : epoch->have_rmc;
    const uint32_t other_ms = rmc ? epoch->gga.time_ms : epoch->rmc.time_ms;
    if (!have_other || other_ms != fields.time_ms) {
        epoch->have_gga = epoch->have_rmc = false;
        epoch->begun_us = begun_us;
    }
    (rmc ? epoch->rmc : epoch->gga) = fields;
    (rmc ? epoch->have_rmc : epoch->have_gga) = true;
    return epoch->have_rmc && epoch->have_gga;
}

// One comes of each constellation; one without a solution of its own says nothing about the others.
void note_gsa(NmeaEpoch *epoch, const NmeaFields &fields) {
    if (fields.quality > epoch->gsa_type) {
        epoch->gsa_type = fields.quality;
        epoch->pdop_centi = epoch->vdop_centi = UNKNOWN;
    }
    if (fields.quality == epoch->gsa_type) {
        epoch->pdop_centi = least(epoch->pdop_centi, fields.dilution[0]);
        epoch->vdop_centi = least(epoch->vdop_centi, fields.dilution[2]);
    }
}

}  // namespace

bool nmea_read(NmeaReader *reader, uint8_t byte) {
    if (byte == '$') {
        begin(reader);
        return false;
    }
    switch (reader->state) {
        case BEGUN:
        case BODY:
            read_body(reader, byte);
            return false;
        case CHECK_HIGH:
            reader->checksum ^= static_cast<uint8_t>(hex_digit(byte) << 4);
            reader->state = CHECK_LOW;
            return false;
        case CHECK_LOW:
            reader->state = IDLE;
            // The high digit has left the low four bits alone.
            if (reader->checksum > 0x0F || reader->checksum != hex_digit(byte)) {
                ++reader->errors;
                return false;
            }
            return true;
        default:
            return false;
    }
}

bool nmea_begun(const NmeaReader *reader) { return reader->state == BEGUN; }

void nmea_start(NmeaReader *reader, NmeaEpoch *epoch) {
    memset(reader, 0, sizeof *reader);
    memset(epoch, 0, sizeof *epoch);
    epoch->delivered_ms = epoch->last_ms = NMEA_NO_TIME;
    epoch->vdop_centi = epoch->pdop_centi = UNKNOWN;
}

bool nmea_join(NmeaEpoch *epoch, const NmeaReader *reader, uint32_t begun_us, WireGpsFix *fix,
               WireGpsQuality *quality) {
    if (reader->kind == NMEA_GSA) {
        note_gsa(epoch, reader->fields);
        return false;
    }
    if (reader->kind == NMEA_OTHER || !note(epoch, *reader, begun_us)) {
        return false;
    }
    fill_fix(*epoch, fix);
    fill_quality(*epoch, quality);
    epoch->delivered_ms = epoch->rmc.time_ms;
    epoch->last_ms = fix_type(*epoch) == FIX_3D ? epoch->rmc.time_ms : NMEA_NO_TIME;
    epoch->last_alt_mm = epoch->gga.alt_amsl_mm;
    epoch->have_rmc = epoch->have_gga = false;
    epoch->gsa_type = 0;
    epoch->vdop_centi = epoch->pdop_centi = UNKNOWN;
    return true;
}
