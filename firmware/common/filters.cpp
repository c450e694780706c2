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

}  // namespace

void low_pass_start(LowPass *filter, int16_t x) {
    const int32_t y = static_cast<int32_t>(x) * (INT32_C(1) << LOW_PASS_OUTPUT_BITS);
    *filter = LowPass{x, x, y, y};
}

void low_pass_update(LowPass *filter, const LowPassDesign &design, int16_t x) {
    const int32_t window = static_cast<int32_t>(x) + INT32_C(2) * filter->x1 + filter->x2;
    // b0 < 0.25 and |window| < 2^17: the product, brought to the output's scale, stays below 2^59.
    int64_t sum = static_cast<int64_t>(design.b0) * (window * (INT32_C(1) << (LOW_PASS_OUTPUT_BITS - 2)));
    sum *= 4;
    sum -= static_cast<int64_t>(design.a1) * filter->y1;
    sum -= static_cast<int64_t>(design.a2) * filter->y2;
    sum += INT32_C(1) << (LOW_PASS_COEFFICIENT_BITS - 1);
    filter->x2 = filter->x1;
    filter->x1 = x;
    filter->y2 = filter->y1;
    filter->y1 = static_cast<int32_t>(sum >> LOW_PASS_COEFFICIENT_BITS);
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
