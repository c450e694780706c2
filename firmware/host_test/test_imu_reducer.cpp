// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdint>

#include "common/imu_reducer.h"
#include "host_test/check.h"

namespace {

ImuReducerSettings settings(uint16_t send_hz, bool raw) {
    return ImuReducerSettings{1000, send_hz, raw, low_pass_design(10, 1000),
                              high_pass_gain(0.001, send_hz)};
}

ImuReading reading(int16_t accel_z, int16_t gyro_x) {
    return ImuReading{{1, -2, accel_z}, -3920, {gyro_x, 0, 0}};
}

}  // namespace

TEST(registers_are_read_big_endian) {
    const uint8_t bytes[14] = {0x00, 0x01, 0xFF, 0xFE, 0x10, 0x00, 0xF0,
                               0xB0, 0x80, 0x00, 0x7F, 0xFF, 0x00, 0x80};
    ImuReading read = {};
    CHECK(imu_read_bytes(bytes, &read));
    CHECK(read.accel[0] == 1 && read.accel[1] == -2 && read.accel[2] == 4096);
    CHECK(read.temperature == -3920);
    CHECK(read.gyro[0] == -32768 && read.gyro[1] == 32767 && read.gyro[2] == 128);
}

TEST(a_reading_of_equal_bytes_is_no_data) {
    for (const uint8_t byte : {uint8_t{0x00}, uint8_t{0xFF}}) {
        uint8_t bytes[14];
        std::fill(bytes, bytes + 14, byte);
        ImuReading read = {};
        CHECK(!imu_read_bytes(bytes, &read));
        bytes[13] ^= 1;
        CHECK(imu_read_bytes(bytes, &read));
    }
}

TEST(payloads_come_at_every_sending_rate) {
    for (const int send_hz : {60, 100, 125, 200, 250}) {
        ImuReducer reducer = {};
        WireImu payload = {};
        int payloads = 0;
        for (int i = 0; i < 3000; ++i) {
            const ImuReducerSettings set = settings(static_cast<uint16_t>(send_hz), false);
            payloads += imu_reduce(&reducer, set, reading(4096, 0), &payload) ? 1 : 0;
        }
        CHECK(payloads == 3 * send_hz);
    }
}

TEST(raw_mode_sends_means_without_filter_flags) {
    ImuReducer reducer = {};
    WireImu payload = {};
    bool due = false;
    for (int16_t i = 1; i <= 10; ++i) {
        due = imu_reduce(&reducer, settings(100, true), reading(i, static_cast<int16_t>(-10 * i)), &payload);
    }
    CHECK(due);
    CHECK(payload.accel[2] == 6 && payload.gyro[0] == -55 && payload.accel[1] == -2);
    CHECK(payload.flags == 0);
    CHECK(payload.temperature == -3920);
}

TEST(filtered_mode_says_so_and_starts_settled) {
    ImuReducer reducer = {};
    WireImu payload = {};
    for (int i = 0; i < 10; ++i) {
        imu_reduce(&reducer, settings(100, false), reading(4096, 500), &payload);
    }
    CHECK(payload.accel[2] == 4096 && payload.gyro[0] == 500);
    CHECK(payload.flags == (WIRE_ACCEL_FILTERED | WIRE_GYRO_FILTERED));
}

TEST(without_a_high_pass_the_rate_passes_and_says_so) {
    ImuReducer reducer = {};
    WireImu payload = {};
    ImuReducerSettings set = settings(100, false);
    set.gyro_highpass_gain = high_pass_gain(0.0, 100);
    for (int i = 0; i < 30000; ++i) {
        imu_reduce(&reducer, set, reading(4096, 500), &payload);
    }
    CHECK(payload.gyro[0] == 500);
    CHECK(payload.flags == WIRE_ACCEL_FILTERED);
}

TEST(clipping_of_one_reading_is_told_once) {
    ImuReducer reducer = {};
    WireImu payload = {};
    const ImuReducerSettings set = settings(100, true);
    for (int i = 0; i < 10; ++i) {
        imu_reduce(&reducer, set, reading(i == 3 ? INT16_MAX : 0, i == 7 ? INT16_MIN : 0), &payload);
    }
    CHECK(payload.flags == (WIRE_ACCEL_CLIPPED | WIRE_GYRO_CLIPPED));
    for (int i = 0; i < 10; ++i) {
        imu_reduce(&reducer, set, reading(0, 0), &payload);
    }
    CHECK(payload.flags == 0);
}
