// SPDX-License-Identifier: Apache-2.0
// Rotation and velocity gained between payloads that are far apart, for a slow link.
//
// The mean of the angular rate is not the rotation: rotations about changing axes do not commute
// (coning). So the rotation vector is integrated [1],
//     phi' = w + phi x w / 2 + phi x (phi x w) / 12,
// and sent as the constant rate that leads to it. The velocity is integrated in the axes at the start
// of the interval,
//     v' = a + phi x a + phi x (phi x a) / 2,
// turned into those half way through it, and sent as the constant specific force that leads to it: the
// gateway applies a sample's force at the attitude half way.
//
// [1] J. E. Bortz, "A new mathematical formulation for strapdown inertial navigation", IEEE
// Transactions on Aerospace and Electronic Systems 7, 1971.
#pragma once

#include "common/imu_reducer.h"

// Angles of products: radians with 14 fraction bits.
constexpr uint8_t INCREMENT_BITS = 14;

// From the sum of a gyroscope's counts, less its lowest 8 bits, to radians of INCREMENT_BITS, with 10
// more fraction bits.
constexpr int16_t increment_scale(double range_dps, double sample_hz) {
    const double rad_per_count = range_dps / 32768.0 * 3.14159265358979323846 / 180.0 / sample_hz;
    return static_cast<int16_t>(rad_per_count * 256.0 * (1 << INCREMENT_BITS) * 1024.0 + 0.5);
}

struct ImuIncrements {
    uint16_t phase;
    uint16_t flags;
    uint8_t count;
    int32_t angle[3];     // rotation vector, in sums of counts
    int32_t velocity[3];  // in the axes at the start, in sums of counts
};

struct ImuIncrementSettings {
    uint16_t sample_hz;
    uint16_t send_hz;
    int16_t scale;  // increment_scale
};

// Takes one reading. True if a payload is due: then its accelerations, rates, temperature and the
// clipping flags are filled in.
bool imu_increment(ImuIncrements *increments, const ImuIncrementSettings &settings,
                   const ImuReading &reading, WireImu *payload);
