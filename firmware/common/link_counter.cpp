// SPDX-License-Identifier: Apache-2.0
#include "common/link_counter.h"

#include <string.h>

namespace {

// A gap this long is a node that came back from out of range with its sequence wrapped, or a
// late duplicate: either way its size means nothing.
constexpr uint16_t LONGEST_GAP = 0x7FFF;

// Payloads carry the time of their sample, so a slow sensor's may be a little older than the one
// sent before it; only a restarted node steps back further.
constexpr int32_t RESTART_US = -500000;

LinkNode *find(LinkCounter *counter, uint8_t vehicle_node) {
    for (uint8_t i = 0; i < LINK_NODES; ++i) {
        LinkNode *node = &counter->nodes[i];
        if (node->vehicle_node == vehicle_node || node->vehicle_node == 0) {
            return node;
        }
    }
    return nullptr;
}

}  // namespace

void link_count(LinkCounter *counter, uint8_t pipe, const uint8_t *payload, uint8_t size) {
    WirePipe *counts = &counter->pipes[pipe];
    ++counts->received;
    WireHeader header;
    if (size < sizeof header) {
        return;
    }
    memcpy(&header, payload, sizeof header);
    LinkNode *node = find(counter, header.vehicle_node);
    if (node == nullptr) {
        return;
    }
    const bool known = node->vehicle_node != 0;
    const bool restarted = static_cast<int32_t>(header.node_time_us - node->node_time_us) < RESTART_US;
    if (known && !restarted) {
        const uint16_t step = static_cast<uint16_t>(header.sequence - node->sequence);
        if (step > 1 && step <= LONGEST_GAP) {
            counts->lost += step - 1U;
        }
    }
    *node = LinkNode{header.vehicle_node, header.sequence, header.node_time_us};
}

void link_overrun(LinkCounter *counter, uint8_t pipe) { ++counter->pipes[pipe].overruns; }
