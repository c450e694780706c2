// SPDX-License-Identifier: Apache-2.0
// The GPS receiver on the UART: found at whatever speed it has stored, configured, watched.
//
// | state     | event                                   | action                              | next      |
// | --------- | --------------------------------------- | ----------------------------------- | --------- |
// | SEARCH    | 4 framing errors                        | listen at the next speed            | SEARCH    |
// | SEARCH    | a valid UBX message or NMEA sentence    | send the port's settings            | PORT      |
// | SEARCH    | neither for 1.3 s                       | the same, from the highest speed on | PORT      |
// | PORT      | sent                                    | GPS_BAUD; send the first settings   | CONFIGURE |
// | CONFIGURE | acknowledged                            | the settings of that generation     | CONFIGURE |
// | CONFIGURE | no answer, but it has been heard        | all other settings                  | CONFIGURE |
// | CONFIGURE | no answer, and it has not been heard    | the next lower speed                | PORT      |
// | CONFIGURE | all sent                                | ask for the version                 | RUNNING   |
// | CONFIGURE | all sent, not heard at GPS_BAUD         | back to its speed, use what comes   | RUNNING   |
// | RUNNING   | a solution                              | hand it on                          | RUNNING   |
// | RUNNING   | no solution for some time               | listen                              | SEARCH    |
//
// Settings go to the receiver's RAM only: what it has stored stays as it is. They are sent in both
// dialects: UBX-CFG-VALSET, which u-blox 9 and 10 take, and the older UBX-CFG messages; whichever is
// acknowledged is followed. A receiver that acknowledges nothing but is heard gets all of them. One
// that goes on with NMEA at its own speed is used like that.
#pragma once

#include <stdint.h>

#include "common/nmea.h"
#include "common/ubx.h"
#include "common/wire.h"

struct Gps {
    uint8_t state;
    uint8_t step;
    uint8_t speed;   // index of the speed at which it is searched for, or was found
    uint8_t answers;  // bits of what the first settings were answered with
    bool sent;
    bool found;  // heard at `speed`, before its port was set
    bool heard;  // a valid message or sentence since the UART's speed was set
    bool seen;   // a solution since the start
    bool solving;  // solutions come in
    bool ubx;    // the last solution was a UBX one
    uint8_t module;       // WireGpsModule
    bool acknowledged;    // the settings
    uint16_t baud_hundreds;
    uint16_t errors_before;  // uart_errors() when the present state began, or at the last solution
    uint16_t failures;     // settings refused, and searches, wraps
    uint16_t errors_seen;  // of line and readers, in every state
    uint16_t errors;       // the same while RUNNING: at a wrong speed there is nothing else
    uint32_t since_us;
    uint32_t byte_us;      // arrival of the last byte
    uint32_t message_us;   // arrival of the present message's first byte
    uint32_t sentence_us;
    uint32_t solution_us;  // arrival of the solution's first byte
    UbxReader reader;
    UbxParts parts;
    NmeaReader nmea;
    NmeaEpoch epoch;
    WireGpsFix fix;
    WireGpsQuality quality;
};

void gps_start(Gps *gps);

// To be called at every event. True if a solution has come in: gps->fix, gps->quality (without their
// headers) and gps->solution_us.
bool gps_poll(Gps *gps);

// Whether solutions come in.
bool gps_running(const Gps *gps);

// What the receiver turned out to be, for the node report.
WireChips gps_chips(const Gps *gps);

// Errors of the line and of the messages while it runs, and failures of the set-up, wraps.
uint16_t gps_errors(const Gps *gps);
