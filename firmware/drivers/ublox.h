// SPDX-License-Identifier: Apache-2.0
// The u-blox M8N on the UART: found at its own speed, configured, watched.
//
// | state       | event                       | action                               | next        |
// | ----------- | --------------------------- | ------------------------------------ | ----------- |
// | CONFIGURING | acknowledged                | next message                         | CONFIGURING |
// | CONFIGURING | the last one acknowledged   |                                      | RUNNING     |
// | CONFIGURING | no answer in 0.3 s          | the other speed; first message again | CONFIGURING |
// | RUNNING     | UBX-NAV-PVT                 | hand it on                           | RUNNING     |
// | RUNNING     | none for 1.5 s              | first message                        | CONFIGURING |
//
// The first message sets the port: UBX alone at GPS_BAUD. It is sent at GPS_BAUD and at the factory's
// 9600 baud in turn, so a receiver that lost its settings, or a node that restarted beside a
// configured receiver, is caught by the next try. The answer to it may come at either speed, so
// its acknowledgement is not waited for: the second message's is.
#pragma once

#include <stdint.h>

#include "common/ubx.h"

struct Ublox {
    uint8_t step;
    bool at_factory_speed;
    bool sent;
    bool seen;  // since the start
    uint32_t since_us;
    uint32_t byte_us;  // arrival of the last byte
    uint32_t message_us;  // arrival of the message's first byte
    uint16_t failures;    // configurations not answered or refused, wraps
    UbxReader reader;
};

void ublox_start(Ublox *ublox);

// To be called at every event. True if a UBX-NAV-PVT has come in: ublox->reader.payload,
// ublox->message_us.
bool ublox_poll(Ublox *ublox);

// Whether messages come in as configured.
bool ublox_running(const Ublox *ublox);
