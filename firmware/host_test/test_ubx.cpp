// SPDX-License-Identifier: Apache-2.0
#include <cstdint>
#include <cstring>
#include <vector>

#include "common/ubx.h"
#include "host_test/check.h"

namespace {

using Bytes = std::vector<uint8_t>;

template <typename T>
void put(Bytes *bytes, size_t at, T value) {
    std::memcpy(bytes->data() + at, &value, sizeof value);
}

Bytes nav_pvt() {
    Bytes pvt(UBX_NAV_PVT_SIZE);
    put<uint32_t>(&pvt, 0, 345600200);
    put<uint16_t>(&pvt, 4, 2026);
    pvt[6] = 11;
    pvt[7] = 19;
    pvt[8] = 23;
    pvt[9] = 59;
    pvt[10] = 2;
    pvt[11] = 0x37;
    put<int32_t>(&pvt, 16, 200000000);
    pvt[20] = 3;
    pvt[21] = 0x01;
    pvt[23] = 14;
    put<int32_t>(&pvt, 24, 1103654321);
    put<int32_t>(&pvt, 28, -77123456);
    put<int32_t>(&pvt, 32, 176700);
    put<int32_t>(&pvt, 36, 153250);
    put<uint32_t>(&pvt, 40, 1799);
    put<uint32_t>(&pvt, 44, 3100);
    put<int32_t>(&pvt, 48, 12340);
    put<int32_t>(&pvt, 52, -5670);
    put<int32_t>(&pvt, 56, -890);
    put<uint32_t>(&pvt, 68, 420);
    put<uint32_t>(&pvt, 72, 275000);
    put<uint16_t>(&pvt, 76, 161);
    return pvt;
}

Bytes message(uint16_t id, const Bytes &payload) {
    Bytes bytes(payload.size() + UBX_OVERHEAD);
    bytes.resize(ubx_write(id, payload.data(), static_cast<uint8_t>(payload.size()), bytes.data()));
    return bytes;
}

int count_messages(UbxReader *reader, const Bytes &bytes) {
    int messages = 0;
    for (const uint8_t byte : bytes) {
        messages += ubx_read(reader, byte) ? 1 : 0;
    }
    return messages;
}

}  // namespace

TEST(writer_gives_the_bytes_of_the_receiver_description) {
    // Poll of UBX-MON-VER: no payload.
    const uint8_t expected[] = {0xB5, 0x62, 0x0A, 0x04, 0x00, 0x00, 0x0E, 0x34};
    uint8_t out[UBX_OVERHEAD];
    const uint8_t nothing = 0;
    CHECK(ubx_write(ubx_id(0x0A, 0x04), &nothing, 0, out) == sizeof expected);
    CHECK(std::memcmp(out, expected, sizeof expected) == 0);
}

TEST(reader_takes_what_the_writer_gives) {
    UbxReader reader = {};
    const Bytes pvt = nav_pvt();
    CHECK(count_messages(&reader, message(UBX_NAV_PVT, pvt)) == 1);
    CHECK(reader.id == UBX_NAV_PVT);
    CHECK(reader.size == UBX_NAV_PVT_SIZE);
    CHECK(std::memcmp(reader.payload, pvt.data(), pvt.size()) == 0);
    CHECK(count_messages(&reader, message(UBX_ACK_ACK, {0x06, 0x01})) == 1);
    CHECK(reader.id == UBX_ACK_ACK);
}

TEST(reader_survives_garbage_and_finds_the_next_message) {
    uint32_t random = 7;
    UbxReader reader = {};
    for (int round = 0; round < 3000; ++round) {
        Bytes bytes(static_cast<size_t>(round % 40));
        for (uint8_t &byte : bytes) {
            random = random * 1664525 + 1013904223;
            byte = static_cast<uint8_t>(random >> 24);
            byte = (random & 0x300) == 0 ? UBX_SYNC_1 : byte;
            byte = (random & 0xC00) == 0 ? UBX_SYNC_2 : byte;
        }
        count_messages(&reader, bytes);
        // Garbage may end in what looks like a header; its length is bounded, so a run of zeros
        // ends it.
        count_messages(&reader, Bytes(UBX_SIZE_MAX + 8));
        CHECK(count_messages(&reader, message(UBX_NAV_PVT, nav_pvt())) == 1);
    }
}

TEST(reader_refuses_every_single_flipped_bit) {
    const Bytes good = message(UBX_NAV_PVT, nav_pvt());
    for (size_t bit = 0; bit < good.size() * 8; ++bit) {
        UbxReader reader = {};
        Bytes bad = good;
        bad[bit / 8] = static_cast<uint8_t>(bad[bit / 8] ^ (1 << bit % 8));
        CHECK(count_messages(&reader, bad) == 0);
    }
}

TEST(nav_pvt_becomes_the_fix) {
    WireGpsFix fix = {};
    ubx_to_fix(nav_pvt().data(), &fix);
    CHECK(fix.itow_ms == 345600200);
    CHECK(fix.lat_dege7 == -77123456);
    CHECK(fix.lon_dege7 == 1103654321);
    CHECK(fix.alt_amsl_mm == 153250);
    CHECK(fix.vel_n_cmps[0] == 1234 && fix.vel_n_cmps[1] == -567 && fix.vel_n_cmps[2] == -89);
    CHECK(fix.fix == (0x80 | 3));
    CHECK(fix.satellites == 14);
}

TEST(velocity_is_held_at_its_ends_and_an_unknown_fix_type_is_none) {
    Bytes pvt = nav_pvt();
    put<int32_t>(&pvt, 48, INT32_MAX);
    put<int32_t>(&pvt, 52, INT32_MIN);
    pvt[20] = 6;
    pvt[21] = 0;
    WireGpsFix fix = {};
    ubx_to_fix(pvt.data(), &fix);
    CHECK(fix.vel_n_cmps[0] == 32767 && fix.vel_n_cmps[1] == -32767);
    CHECK(fix.fix == 0);
}

TEST(nav_pvt_becomes_the_quality) {
    WireGpsQuality quality = {};
    ubx_to_quality(nav_pvt().data(), &quality);
    CHECK(quality.h_acc_cm == 180 && quality.v_acc_cm == 310);
    CHECK(quality.speed_acc_cmps == 42 && quality.course_acc_cdeg == 275);
    CHECK(quality.pdop_centi == 161 && quality.geoid_separation_cm == 2345);
    CHECK(quality.time_valid == 1 && quality.year == 26 && quality.month == 11 && quality.day == 19);
    CHECK(quality.hour == 23 && quality.minute == 59 && quality.second == 2);
    CHECK(quality.hundredths == 20);
}

TEST(time_is_valid_only_if_the_receiver_says_so) {
    for (const int valid : {0x00, 0x03, 0x06, 0x05}) {
        Bytes pvt = nav_pvt();
        pvt[11] = static_cast<uint8_t>(valid);
        WireGpsQuality quality;
        std::memset(&quality, 0xAA, sizeof quality);
        ubx_to_quality(pvt.data(), &quality);
        CHECK(quality.time_valid == 0 && quality.year == 0 && quality.hundredths == 0);
    }
    Bytes leap = nav_pvt();
    leap[10] = 60;
    WireGpsQuality quality = {};
    ubx_to_quality(leap.data(), &quality);
    CHECK(quality.time_valid == 0);
}

TEST(quality_is_held_at_its_ends) {
    Bytes pvt = nav_pvt();
    for (const size_t at : {40, 44, 68, 72}) {
        put<uint32_t>(&pvt, at, UINT32_MAX);
    }
    put<int32_t>(&pvt, 16, -4000000);
    put<int32_t>(&pvt, 32, INT32_MAX);
    WireGpsQuality quality = {};
    ubx_to_quality(pvt.data(), &quality);
    CHECK(quality.h_acc_cm == 65535 && quality.v_acc_cm == 65535 && quality.speed_acc_cmps == 65535);
    CHECK(quality.course_acc_cdeg == 65535);
    CHECK(quality.geoid_separation_cm == 32767);
    CHECK(quality.hundredths == 0);
}

TEST(a_long_message_is_read_past_and_its_head_kept) {
    UbxReader reader = {};
    Bytes version(220, ' ');
    std::memcpy(version.data() + 30, "00190000", 8);
    CHECK(count_messages(&reader, message(UBX_MON_VER, version)) == 1);
    CHECK(reader.size == 220 && ubx_generation(&reader) == 9);
    CHECK(count_messages(&reader, message(UBX_NAV_PVT, nav_pvt())) == 1);
    CHECK(ubx_generation(&reader) == 0);
}

TEST(every_generation_is_known_by_its_hardware_version) {
    const struct {
        const char *version;
        int generation;
    } cases[] = {{"00040007", 6}, {"00070000", 7}, {"00080000", 8}, {"00190000", 9},
                 {"000A0000", 10}, {"00180000", 0}, {"\0\0\0\0\0\0\0\0", 0}};
    for (const auto &one : cases) {
        UbxReader reader = {};
        Bytes version(40);
        std::memcpy(version.data() + 30, one.version, 8);
        CHECK(count_messages(&reader, message(UBX_MON_VER, version)) == 1);
        CHECK(ubx_generation(&reader) == one.generation);
    }
}
