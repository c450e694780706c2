// SPDX-License-Identifier: Apache-2.0
// What arrived on each radio pipe and what did not, from the payloads' own sequence numbers.
#pragma once

#include <stdint.h>

#include "common/wire.h"

// Two nodes a pipe; further nodes are counted as received, but their gaps are not known.
constexpr uint8_t LINK_NODES = 2 * WIRE_PIPES;

struct LinkNode {
    uint8_t vehicle_node;  // 0: free
    uint16_t sequence;
    uint32_t node_time_us;
};

struct LinkCounter {
    LinkNode nodes[LINK_NODES];
    WirePipe pipes[WIRE_PIPES];
};

// Counts one payload. A node whose time went back has restarted: its gap is not a loss.
void link_count(LinkCounter *counter, uint8_t pipe, const uint8_t *payload, uint8_t size);

// Counts a receive FIFO that was found full: packets behind it were refused by the radio.
void link_overrun(LinkCounter *counter, uint8_t pipe);
