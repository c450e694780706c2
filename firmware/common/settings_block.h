// SPDX-License-Identifier: Apache-2.0
// The settings block: 46 bytes of each program's image that hold what differs between users.
// `mavgate flash` patches them in the image before it is uploaded, so nobody needs a compiler; as
// built, they hold the values of settings.h. gateway/flashing/boards.py reads and writes the
// same bytes.
#pragma once

#include <stdint.h>

#include "common/crc16.h"
#include "common/firmware_version.h"

// Raised when the layout changes. A new field takes a reserved byte or goes before the CRC.
constexpr uint8_t SETTINGS_VERSION = 1;

enum SettingsProgram : uint8_t { PROGRAM_IMU_NODE = 1, PROGRAM_GPS_NODE = 2, PROGRAM_RECEIVER = 3 };

enum SettingsRadio : uint8_t { SETTINGS_NRF24 = 0, SETTINGS_SX1276 = 1 };

struct __attribute__((packed)) SettingsBlock {
    char magic[7];  // "mavgate": the block is found by it, wherever the linker puts it
    uint8_t version;
    uint8_t program;
    uint8_t clock_mhz;
    uint8_t firmware_major;
    uint8_t firmware_minor;
    uint8_t vehicle_id;
    uint8_t node_id;
    uint8_t radio_pipe;
    uint8_t radio_channel;
    uint16_t radio_kbps;
    uint8_t radio_power;
    uint8_t imu_send_hz;
    uint32_t radio_address;
    uint8_t imu_raw;
    uint8_t accel_range;
    uint8_t gyro_range;
    uint8_t gps_rate_hz;
    uint8_t gps_dynamic_model;
    uint8_t soft_restart;  // the bootloader leaves the watchdog on, see board.h
    uint8_t reserved[2];
    uint8_t radio;  // SettingsRadio: the driver in this image
    uint32_t lora_frequency_khz;
    uint16_t lora_bandwidth_khz;
    uint8_t lora_spreading;
    uint8_t lora_coding;
    uint8_t lora_power_dbm;
    uint8_t lora_sync_word;
    uint8_t lora_foreign;  // the receiver passes packets of other programs on
    uint16_t crc;  // CRC-16 of all before it
};
static_assert(sizeof(SettingsBlock) == 46, "gateway/flashing/boards.py");

// The block as the bytes of the image. A constant expression cannot look at a struct's bytes, and
// the CRC has to be one: so the fields are written one by one.
struct SettingsImage {
    uint8_t bytes[sizeof(SettingsBlock)];
};

constexpr SettingsImage settings_image(const SettingsBlock &block) {
    SettingsImage image = {};
    uint8_t size = 0;
    for (uint8_t i = 0; i < sizeof block.magic; ++i) {
        image.bytes[size++] = static_cast<uint8_t>(block.magic[i]);
    }
    const uint8_t fields[] = {
        block.version,
        block.program,
        block.clock_mhz,
        block.firmware_major,
        block.firmware_minor,
        block.vehicle_id,
        block.node_id,
        block.radio_pipe,
        block.radio_channel,
        static_cast<uint8_t>(block.radio_kbps),
        static_cast<uint8_t>(block.radio_kbps >> 8),
        block.radio_power,
        block.imu_send_hz,
        static_cast<uint8_t>(block.radio_address),
        static_cast<uint8_t>(block.radio_address >> 8),
        static_cast<uint8_t>(block.radio_address >> 16),
        static_cast<uint8_t>(block.radio_address >> 24),
        block.imu_raw,
        block.accel_range,
        block.gyro_range,
        block.gps_rate_hz,
        block.gps_dynamic_model,
        block.soft_restart,
        block.reserved[0],
        block.reserved[1],
        block.radio,
        static_cast<uint8_t>(block.lora_frequency_khz),
        static_cast<uint8_t>(block.lora_frequency_khz >> 8),
        static_cast<uint8_t>(block.lora_frequency_khz >> 16),
        static_cast<uint8_t>(block.lora_frequency_khz >> 24),
        static_cast<uint8_t>(block.lora_bandwidth_khz),
        static_cast<uint8_t>(block.lora_bandwidth_khz >> 8),
        block.lora_spreading,
        block.lora_coding,
        block.lora_power_dbm,
        block.lora_sync_word,
        block.lora_foreign,
    };
    for (uint8_t field : fields) {
        image.bytes[size++] = field;
    }
    uint16_t crc = CRC16_START;
    for (uint8_t i = 0; i < size; ++i) {
        crc = crc16_update(crc, image.bytes[i]);
    }
    image.bytes[size++] = static_cast<uint8_t>(crc);
    image.bytes[size++] = static_cast<uint8_t>(crc >> 8);
    return image;
}

// Whether the block is whole and of this layout.
inline bool settings_valid(const SettingsBlock &block) {
    const uint8_t *bytes = reinterpret_cast<const uint8_t *>(&block);
    uint16_t crc = CRC16_START;
    for (uint8_t i = 0; i < sizeof block - sizeof block.crc; ++i) {
        crc = crc16_update(crc, bytes[i]);
    }
    return crc == block.crc && block.version == SETTINGS_VERSION;
}
