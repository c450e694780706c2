// SPDX-License-Identifier: Apache-2.0
// Payload structs and serial frames against the golden vectors that the gateway reads too.
#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

#include "common/crc16.h"
#include "common/frame.h"
#include "common/wire.h"
#include "host_test/check.h"

namespace {

using Bytes = std::vector<uint8_t>;

template <typename T>
Bytes bytes_of(const T &value) {
    Bytes bytes(sizeof value);
    std::memcpy(bytes.data(), &value, sizeof value);
    return bytes;
}

struct Vector {
    const char *name;
    Bytes value;
    uint8_t frame_seq;
    uint8_t pipe;
    uint32_t receiver_time_us;
    const char *payload_hex;
    const char *content_hex;
    const char *frame_hex;
};

Bytes from_hex(const char *digits) {
    Bytes bytes;
    for (const std::string text = digits; bytes.size() * 2 < text.size();) {
        bytes.push_back(static_cast<uint8_t>(std::stoi(text.substr(bytes.size() * 2, 2), nullptr, 16)));
    }
    return bytes;
}

#include "vectors.inc"

Bytes encode(const Bytes &content) {
    Bytes frame(FRAME_MAX_SIZE);
    frame.resize(frame_encode(content.data(), static_cast<uint8_t>(content.size()), frame.data()));
    return frame;
}

// A plain COBS decoder, for the round trip.
Bytes unstuff(const Bytes &frame) {
    Bytes out;
    for (size_t at = 0; at + 1 < frame.size();) {
        const uint8_t code = frame[at];
        out.insert(out.end(), frame.begin() + static_cast<long>(at) + 1,
                   frame.begin() + static_cast<long>(at + code));
        at += code;
        if (at + 1 < frame.size()) {
            out.push_back(0);
        }
    }
    return out;
}

}  // namespace

TEST(payload_structs_are_the_golden_payloads) {
    for (const Vector &vector : VECTORS) {
        const bool is_payload = vector.payload_hex[0] != 0;
        CHECK(vector.value == from_hex(is_payload ? vector.payload_hex : vector.content_hex));
    }
}

TEST(radio_frames_are_the_golden_contents) {
    for (const Vector &vector : VECTORS) {
        const Bytes payload = from_hex(vector.payload_hex);
        if (payload.empty()) {
            continue;
        }
        WireRadioFrame frame = {};
        frame.header = WireFrameHeader{wire_version_kind(WIRE_RADIO), vector.frame_seq, vector.pipe,
                                       vector.receiver_time_us};
        std::memcpy(frame.payload, payload.data(), payload.size());
        Bytes content = bytes_of(frame);
        content.resize(sizeof(WireFrameHeader) + payload.size());
        CHECK(content == from_hex(vector.content_hex));
    }
}

TEST(frames_are_the_golden_frames) {
    for (const Vector &vector : VECTORS) {
        CHECK(encode(from_hex(vector.content_hex)) == from_hex(vector.frame_hex));
    }
}

TEST(crc_gives_the_check_value) {
    uint16_t crc = CRC16_START;
    for (const char digit : std::string("123456789")) {
        crc = crc16_update(crc, static_cast<uint8_t>(digit));
    }
    CHECK(crc == 0x29B1);
}

TEST(frames_of_every_length_and_many_zeros_come_back) {
    uint32_t random = 1;
    for (int round = 0; round < 2000; ++round) {
        Bytes content(static_cast<size_t>(round % (FRAME_MAX_CONTENT + 1)));
        for (uint8_t &byte : content) {
            random = random * 1664525 + 1013904223;
            byte = (random >> 28) < 6 ? 0 : static_cast<uint8_t>(random >> 16);
        }
        const Bytes frame = encode(content);
        CHECK(frame.size() <= FRAME_MAX_SIZE);
        CHECK(std::memchr(frame.data(), 0, frame.size()) == frame.data() + frame.size() - 1);
        Bytes back = unstuff(frame);
        CHECK(back.size() == content.size() + 2);
        back.resize(content.size());
        CHECK(back == content);
    }
}
