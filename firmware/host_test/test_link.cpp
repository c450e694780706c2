// SPDX-License-Identifier: Apache-2.0
// Loss counting, the payload queue and the back-off generator.
#include <cstdint>
#include <cstring>

#include "common/link_counter.h"
#include "common/payload_queue.h"
#include "common/random16.h"
#include "host_test/check.h"

namespace {

void receive(LinkCounter *counter, uint8_t pipe, uint8_t vehicle, uint16_t sequence, uint32_t time_us) {
    const WireHeader header = {wire_version_kind(WIRE_BARO), wire_vehicle_node(vehicle, 0), sequence,
                               time_us};
    uint8_t payload[WIRE_MAX_PAYLOAD] = {};
    std::memcpy(payload, &header, sizeof header);
    link_count(counter, pipe, payload, sizeof(WireBaro));
}

}  // namespace

TEST(gaps_are_losses_also_where_sequence_and_time_wrap) {
    LinkCounter counter = {};
    receive(&counter, 2, 1, 65533, 0xFFFFFF00);
    receive(&counter, 2, 1, 65534, 0xFFFFFFF0);
    receive(&counter, 2, 1, 1, 0x10);
    receive(&counter, 2, 1, 1, 0x10);
    CHECK(counter.pipes[2].received == 4);
    CHECK(counter.pipes[2].lost == 2);
    CHECK(counter.pipes[1].received == 0);
}

TEST(a_restarted_node_has_lost_nothing) {
    LinkCounter counter = {};
    receive(&counter, 0, 1, 500, 60000000);
    receive(&counter, 0, 1, 7, 40000);
    receive(&counter, 0, 1, 9, 60000);
    CHECK(counter.pipes[0].lost == 1);
}

TEST(an_older_sample_behind_a_newer_one_is_no_restart) {
    LinkCounter counter = {};
    receive(&counter, 0, 1, 10, 1000000);
    receive(&counter, 0, 1, 13, 990000);
    CHECK(counter.pipes[0].lost == 2);
}

TEST(nodes_that_share_a_pipe_are_counted_apart) {
    LinkCounter counter = {};
    for (uint16_t i = 0; i < 10; ++i) {
        receive(&counter, 3, 1, static_cast<uint16_t>(100 + i), 1000U * i);
        receive(&counter, 3, 2, static_cast<uint16_t>(9000 + 2 * i), 1000U * i);
    }
    CHECK(counter.pipes[3].received == 20);
    CHECK(counter.pipes[3].lost == 9);
}

TEST(more_nodes_than_the_table_holds_are_still_counted) {
    LinkCounter counter = {};
    for (uint8_t vehicle = 1; vehicle < 32; ++vehicle) {
        receive(&counter, 5, vehicle, 1, 1000);
    }
    CHECK(counter.pipes[5].received == 31);
    link_overrun(&counter, 5);
    CHECK(counter.pipes[5].overruns == 1);
}

TEST(short_payloads_are_counted_and_not_read) {
    LinkCounter counter = {};
    const uint8_t one = 0x11;
    link_count(&counter, 0, &one, 1);
    CHECK(counter.pipes[0].received == 1 && counter.pipes[0].lost == 0);
}

TEST(queue_keeps_order_and_drops_the_oldest) {
    PayloadQueue queue = {};
    CHECK(payload_queue_front(&queue) == nullptr);
    payload_queue_pop(&queue);
    for (uint8_t i = 0; i < PAYLOAD_QUEUE_SIZE + 3; ++i) {
        payload_queue_push(&queue, &i, 1, false);
    }
    CHECK(queue.dropped == 3);
    for (uint8_t i = 3; i < PAYLOAD_QUEUE_SIZE + 3; ++i) {
        CHECK(payload_queue_front(&queue)->bytes[0] == i);
        payload_queue_pop(&queue);
    }
    CHECK(payload_queue_front(&queue) == nullptr);
}

TEST(queue_keeps_the_payload_that_is_being_sent) {
    PayloadQueue queue = {};
    for (uint8_t i = 0; i < PAYLOAD_QUEUE_SIZE + 3; ++i) {
        payload_queue_push(&queue, &i, 1, true);
    }
    CHECK(queue.dropped == 3);
    CHECK(payload_queue_front(&queue)->bytes[0] == 0);
    payload_queue_pop(&queue);
    for (uint8_t i = 4; i < PAYLOAD_QUEUE_SIZE + 3; ++i) {
        CHECK(payload_queue_front(&queue)->bytes[0] == i);
        payload_queue_pop(&queue);
    }
    CHECK(payload_queue_front(&queue) == nullptr);
}

TEST(random16_visits_every_state) {
    uint16_t state = 1;
    uint32_t steps = 0;
    do {
        state = random16_next(state);
        ++steps;
    } while (state != 1 && steps < 70000);
    CHECK(steps == 65535);
}
