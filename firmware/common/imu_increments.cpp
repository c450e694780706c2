// SPDX-License-Identifier: Apache-2.0
#include "common/imu_increments.h"

namespace {

constexpr int32_t HALF = INT32_C(1) << (INCREMENT_BITS - 1);

struct Angle {
    int16_t axes[3];
};

int16_t saturated(int32_t value) {
    return value > INT16_MAX   ? static_cast<int16_t>(INT16_MAX)
           : value < INT16_MIN ? static_cast<int16_t>(INT16_MIN)
                               : static_cast<int16_t>(value);
}

Angle angle_of(const ImuIncrements *increments, int16_t scale) {
    Angle angle;
    for (uint8_t axis = 0; axis < 3; ++axis) {
        const int16_t upper = saturated(increments->angle[axis] >> 8);
        angle.axes[axis] = saturated((static_cast<int32_t>(upper) * scale) >> 10);
    }
    return angle;
}

int16_t component(int16_t angle_a, int16_t counts_b, int16_t angle_b, int16_t counts_a) {
    const int32_t sum = static_cast<int32_t>(angle_a) * counts_b - static_cast<int32_t>(angle_b) * counts_a;
    return saturated((sum + HALF) >> INCREMENT_BITS);
}

// The vector product of an angle and counts, rounded to counts.
void cross(const Angle &angle, const int16_t counts[3], int16_t product[3]) {
    const int16_t *a = angle.axes;
    product[0] = component(a[1], counts[2], a[2], counts[1]);
    product[1] = component(a[2], counts[0], a[0], counts[2]);
    product[2] = component(a[0], counts[1], a[1], counts[0]);
}

// A division would take 220 cycles.
int16_t twelfth(int16_t counts) {
    return static_cast<int16_t>((static_cast<int32_t>(counts) * 5461 + INT32_C(0x8000)) >> 16);
}

bool at_end(int16_t counts) { return counts == INT16_MAX || counts == INT16_MIN; }

void integrate(ImuIncrements *increments, int16_t scale, const ImuReading &reading) {
    // Half way through the reading's own interval.
    Angle angle = angle_of(increments, scale);
    const Angle start = angle;
    for (uint8_t axis = 0; axis < 3; ++axis) {
        const int32_t half = (static_cast<int32_t>(reading.gyro[axis]) * scale + (INT32_C(1) << 18)) >> 19;
        angle.axes[axis] = saturated(angle.axes[axis] + half);
    }
    int16_t once[3];
    int16_t twice[3];
    cross(start, reading.gyro, once);
    cross(start, once, twice);
    for (uint8_t axis = 0; axis < 3; ++axis) {
        increments->angle[axis] += reading.gyro[axis] + once[axis] / 2 + twelfth(twice[axis]);
        if (at_end(reading.gyro[axis])) {
            increments->flags |= WIRE_GYRO_CLIPPED;
        }
    }
    cross(angle, reading.accel, once);
    cross(angle, once, twice);
    for (uint8_t axis = 0; axis < 3; ++axis) {
        increments->velocity[axis] += reading.accel[axis] + once[axis] + twice[axis] / 2;
        if (at_end(reading.accel[axis])) {
            increments->flags |= WIRE_ACCEL_CLIPPED;
        }
    }
    ++increments->count;
}

int16_t mean_of(int32_t sum, int16_t count) {
    const int32_t half = sum < 0 ? -(count / 2) : count / 2;
    return saturated((sum + half) / count);
}

void give(ImuIncrements *increments, int16_t scale, WireImu *payload) {
    const int16_t count = increments->count;
    Angle half = angle_of(increments, scale);
    int16_t force[3];
    for (uint8_t axis = 0; axis < 3; ++axis) {
        half.axes[axis] = static_cast<int16_t>(half.axes[axis] / 2);
        force[axis] = mean_of(increments->velocity[axis], count);
        payload->gyro[axis] = mean_of(increments->angle[axis], count);
        // The rounding is made up for by the next payload, or its errors would add up.
        increments->angle[axis] -= static_cast<int32_t>(payload->gyro[axis]) * count;
        increments->velocity[axis] = 0;
    }
    int16_t once[3];
    int16_t twice[3];
    cross(half, force, once);
    cross(half, once, twice);
    for (uint8_t axis = 0; axis < 3; ++axis) {
        payload->accel[axis] = saturated(static_cast<int32_t>(force[axis]) - once[axis] + twice[axis] / 2);
    }
    payload->flags = increments->flags;
    increments->flags = 0;
    increments->count = 0;
}

}  // namespace

bool imu_increment(ImuIncrements *increments, const ImuIncrementSettings &settings,
                   const ImuReading &reading, WireImu *payload) {
    integrate(increments, settings.scale, reading);
    increments->phase = static_cast<uint16_t>(increments->phase + settings.send_hz);
    if (increments->phase < settings.sample_hz && increments->count < UINT8_MAX) {
        return false;
    }
    increments->phase = static_cast<uint16_t>(increments->phase % settings.sample_hz);
    payload->temperature = reading.temperature;
    give(increments, settings.scale, payload);
    return true;
}
