// SPDX-License-Identifier: Apache-2.0
#include "common/filters.h"

namespace {

int16_t saturate(int32_t value) {
    if (value > INT16_MAX) {
        return INT16_MAX;
    }
    if (value < INT16_MIN) {
        return INT16_MIN;
    }
    return static_cast<int16_t>(value);
}

// A positive coefficient of 31 fraction bits times a value, halved: the upper half of the product,
// out of three products of 16 bits. The fourth counts for less than one unit and is left out; AVR
// takes twice as long for all 64 bits.
int32_t scale(int32_t coefficient, int32_t value) {
    const int16_t c_high = static_cast<int16_t>(coefficient >> 16);
    const uint16_t c_low = static_cast<uint16_t>(coefficient);
    const int16_t v_high = static_cast<int16_t>(value >> 16);
    const uint16_t v_low = static_cast<uint16_t>(value);
    return static_cast<int32_t>(v_high) * c_high + (static_cast<int32_t>(v_high) * c_low >> 16) +
           (static_cast<int32_t>(v_low) * c_high >> 16);
}

}  // namespace

void low_pass_start(LowPass *filter, int16_t x) {
    const int32_t y = static_cast<int32_t>(x) * (INT32_C(1) << LOW_PASS_OUTPUT_BITS);
    *filter = LowPass{x, x, y, y};
}

void low_pass_update(LowPass *filter, const LowPassDesign &design, int16_t x) {
    const int32_t window = static_cast<int32_t>(x) + INT32_C(2) * filter->x1 + filter->x2;
    // Each product loses a unit and a quarter in the mean; two of the losses cancel.
    const int32_t correction = scale(design.b0, window * (INT32_C(1) << LOW_PASS_OUTPUT_BITS)) -
                               scale(design.c1, filter->y1) + scale(design.c2, filter->y2);
    const int32_t y = 2 * filter->y1 - filter->y2 + 2 * correction + 2;
    filter->x2 = filter->x1;
    filter->x1 = x;
    filter->y2 = filter->y1;
    filter->y1 = y;
}

int16_t low_pass_output(const LowPass *filter) {
    return saturate((filter->y1 + (INT32_C(1) << (LOW_PASS_OUTPUT_BITS - 1))) >> LOW_PASS_OUTPUT_BITS);
}

int16_t high_pass_update(HighPass *filter, uint32_t gain, int16_t x) {
    const int32_t mean = (filter->mean + INT32_C(0x8000)) >> 16;
    const int64_t difference = static_cast<int64_t>(x) * 65536 - filter->mean;
    filter->mean += static_cast<int32_t>((difference * gain) >> 32);
    return saturate(x - mean);
}

void mean_add(Mean *mean, int16_t x) {
    mean->sum += x;
    ++mean->count;
}

int16_t mean_take(Mean *mean) {
    const int32_t count = mean->count;
    if (count == 0) {
        return 0;
    }
    const int32_t half = mean->sum < 0 ? -count / 2 : count / 2;
    const int32_t value = (mean->sum + half) / count;
    *mean = Mean{0, 0};
    return static_cast<int16_t>(value);
}
