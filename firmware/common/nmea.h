// SPDX-License-Identifier: Apache-2.0
// NMEA 0183 byte by byte: RMC, GGA and GSA of any talker, joined to the payloads of one fix.
//
// A fix is complete when RMC and GGA of one time have come, in either order. Several talkers may
// repeat them (GP, GL, GN): a time that has been delivered is not delivered again. GSA gives the fix
// type and the vertical dilution; it belongs to the fix that ends next. Of several, one for each
// constellation, the best fix type counts, with the least dilutions among those that have it.
//
// NMEA has no accuracies. They are made from the dilutions of precision with the range errors below,
// so that an estimator weighs these fixes as what they are.
#pragma once

#include <stdint.h>

#include "common/wire.h"

// Standard deviations per unit of dilution, of a single-frequency receiver under open sky: position
// horizontally, vertically, and velocity. The velocity down is the difference of two heights, so its
// error sets the last one.
constexpr uint16_t NMEA_H_ACC_CM = 400;
constexpr uint16_t NMEA_V_ACC_CM = 400;
constexpr uint16_t NMEA_SPEED_ACC_CMPS = 100;

constexpr uint8_t NMEA_FIELD_SIZE = 14;  // 12 characters of a longitude to 1e-7 minutes, and zero

enum NmeaKind : uint8_t { NMEA_OTHER, NMEA_RMC, NMEA_GGA, NMEA_GSA };

// What one sentence holds; fields that its kind lacks keep their defaults.
struct NmeaFields {
    uint32_t time_ms;  // of the day, NMEA_NO_TIME if empty
    uint32_t date;     // ddmmyy, 0 if empty
    int32_t lat_dege7;
    int32_t lon_dege7;
    int32_t alt_amsl_mm;
    int32_t geoid_mm;
    int32_t speed_mmps;
    int32_t course_cdeg;
    uint16_t dilution[3];  // GGA: horizontal first; GSA: position, horizontal, vertical; 0.01
    uint8_t quality;       // GGA, or 1 and 0 for RMC's A and V, or GSA's fix type
    uint8_t satellites;
};

constexpr uint32_t NMEA_NO_TIME = 0xFFFFFFFF;

struct NmeaReader {
    uint8_t state;
    uint8_t checksum;
    uint8_t kind;  // NmeaKind of the sentence that is being read, or was last
    uint8_t field;
    uint8_t length;
    char text[NMEA_FIELD_SIZE];
    uint16_t errors;  // checksums that did not hold, wraps
    NmeaFields fields;
};

// Takes one byte. True if it completes a sentence with a correct checksum, of any kind.
bool nmea_read(NmeaReader *reader, uint8_t byte);

// True if the last byte was the first of a sentence.
bool nmea_begun(const NmeaReader *reader);

// The fix that RMC, GGA and GSA are joined to.
struct NmeaEpoch {
    bool have_rmc;
    bool have_gga;
    uint8_t gsa_type;  // 0: none since the last fix
    uint16_t vdop_centi;
    uint16_t pdop_centi;
    uint32_t begun_us;  // arrival of the first byte of its first sentence
    uint32_t delivered_ms;
    uint32_t last_ms;  // of the last fix with a height
    int32_t last_alt_mm;
    NmeaFields rmc;
    NmeaFields gga;
};

void nmea_start(NmeaReader *reader, NmeaEpoch *epoch);

// Takes a completed sentence, whose first byte came at `begun_us`. True if it completes a fix: then
// both payloads are filled in, all but their headers.
bool nmea_join(NmeaEpoch *epoch, const NmeaReader *reader, uint32_t begun_us, WireGpsFix *fix,
               WireGpsQuality *quality);
