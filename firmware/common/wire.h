// SPDX-License-Identifier: Apache-2.0
// The bytes of PROTOCOL.md. AVR and PC are both little-endian and the structs are packed, so a
// struct in memory is the payload on the air.
#pragma once

#include <stdint.h>

constexpr uint8_t WIRE_VERSION = 1;
constexpr uint8_t WIRE_MAX_PAYLOAD = 32;  // one nRF24L01+ packet
constexpr uint8_t WIRE_MAX_FOREIGN = 60;  // of a packet of another program, header included
constexpr uint8_t WIRE_PIPES = 6;
constexpr uint8_t WIRE_NO_PIPE = 0xFF;
constexpr uint8_t WIRE_LORA_CHANNEL = 0xFF;  // in place of an nRF24 channel

enum WirePayloadKind : uint8_t {
    WIRE_IMU = 1,
    WIRE_BARO = 2,
    WIRE_GPS_FIX = 3,
    WIRE_GPS_QUALITY = 4,
    WIRE_NODE_STATUS = 5,
};

enum WireFrameKind : uint8_t {
    WIRE_RADIO = 1,
    WIRE_RECEIVER_STATUS = 2,
    WIRE_RADIO_SIGNAL = 3,  // as 1, with the packet's signal
    WIRE_FOREIGN = 4,       // a packet of another program
};

enum WireImuFlag : uint16_t {
    WIRE_ACCEL_FILTERED = 1 << 0,
    WIRE_GYRO_FILTERED = 1 << 1,
    WIRE_MAG_NEW = 1 << 2,
    WIRE_MAG_ABSENT = 1 << 3,
    WIRE_BARO_ABSENT = 1 << 4,
    WIRE_SELF_TEST_FAILED = 1 << 5,
    WIRE_ACCEL_CLIPPED = 1 << 6,
    WIRE_GYRO_CLIPPED = 1 << 7,
};

enum WireSensor : uint8_t {
    WIRE_SENSOR_IMU = 1 << 0,
    WIRE_SENSOR_MAG = 1 << 1,
    WIRE_SENSOR_BARO = 1 << 2,
    WIRE_SENSOR_GPS = 1 << 3,
};

// What a GPS receiver turned out to be; 6 to 10 are the generations of u-blox.
enum WireGpsModule : uint8_t {
    WIRE_GPS_UNKNOWN = 0,
    WIRE_GPS_NMEA = 1,
    WIRE_GPS_UBX = 2,  // of a generation that it does not name
    WIRE_GPS_UBX_6 = 6,
};
constexpr uint8_t WIRE_GPS_ACKNOWLEDGES = 1 << 4;

// Scales of the magnetometer: 0 to 7 are the HMC5883L's gain codes.
enum WireMagScale : uint8_t {
    WIRE_MAG_QMC5883L_8G = 8,  // 3000 counts per gauss
    WIRE_MAG_QMC5883P_8G = 9,  // 3750 counts per gauss
};

constexpr int16_t WIRE_MAG_OVERFLOW = -4096;

// The radio module of the board that reports: bits 4 to 7, next to the reset cause.
enum WireRadioState : uint8_t {
    WIRE_RADIO_OK = 0,
    WIRE_RADIO_ABSENT = 1,          // does not answer
    WIRE_RADIO_LOSES_SETTINGS = 2,  // does not keep its configuration
    WIRE_RADIO_ACTIVATED = 3,       // works, but needed ACTIVATE: no nRF24L01+
};

#define WIRE_PACKED __attribute__((packed))

struct WIRE_PACKED WireHeader {
    uint8_t version_kind;
    uint8_t vehicle_node;
    uint16_t sequence;
    uint32_t node_time_us;
};
static_assert(sizeof(WireHeader) == 8, "PROTOCOL.md: payload header");

struct WIRE_PACKED WireImu {
    WireHeader header;
    int16_t accel[3];      // 32768 / range g per count
    int16_t gyro[3];       // 131, 65.5, 32.8 or 16.4 counts per deg/s
    int16_t mag[3];        // x, y, z on the HMC5883L's axes
    int16_t temperature;   // degC = counts / 340 + 36.53
    uint16_t flags;        // WireImuFlag
    uint8_t ranges;        // bits 0-1 accelerometer, 2-3 gyroscope, 4-7 magnetometer scale
};
static_assert(sizeof(WireImu) == 31, "PROTOCOL.md: kind 1");

struct WIRE_PACKED WireBaro {
    WireHeader header;
    uint32_t pressure_centipa;
    int16_t temperature_ddegc;
};
static_assert(sizeof(WireBaro) == 14, "PROTOCOL.md: kind 2");

struct WIRE_PACKED WireGpsFix {
    WireHeader header;
    uint32_t itow_ms;
    int32_t lat_dege7;
    int32_t lon_dege7;
    int32_t alt_amsl_mm;
    int16_t vel_n_cmps[3];
    uint8_t fix;           // bits 0-6 fix type, bit 7 gnssFixOK
    uint8_t satellites;
};
static_assert(sizeof(WireGpsFix) == 32, "PROTOCOL.md: kind 3");

struct WIRE_PACKED WireGpsQuality {
    WireHeader header;
    uint32_t itow_ms;
    uint16_t h_acc_cm;
    uint16_t v_acc_cm;
    uint16_t speed_acc_cmps;
    uint16_t course_acc_cdeg;
    uint16_t pdop_centi;
    int16_t geoid_separation_cm;
    uint8_t time_valid;
    uint8_t year;          // since 2000
    uint8_t month;
    uint8_t day;
    uint8_t hour;
    uint8_t minute;
    uint8_t second;
    uint8_t hundredths;
};
static_assert(sizeof(WireGpsQuality) == 32, "PROTOCOL.md: kind 4");

// Which chips a node has found, by what they call themselves; 0 where there is none.
struct WIRE_PACKED WireChips {
    uint8_t imu;            // WHO_AM_I
    uint8_t magnetometer;   // I2C address
    uint8_t barometer;      // chip id, register 0xD0
    uint8_t gps;            // bits 0-3 WireGpsModule, bit 4 it acknowledges its settings
    uint16_t gps_baud;      // hundreds of baud
};

struct WIRE_PACKED WireNodeStatus {
    WireHeader header;
    uint8_t version_major;
    uint8_t version_minor;
    uint8_t reset_and_radio;  // bits 0-3 MCUSR, 4-7 WireRadioState
    uint8_t sensors_present;  // WireSensor
    uint8_t sensors_failed;
    uint16_t bus_errors;
    uint16_t radio_failed;
    uint16_t radio_retries;
    uint16_t loop_max_us;
    uint16_t sample_rate_hz;
    uint16_t supply_mv;
    WireChips chips;
};
static_assert(sizeof(WireNodeStatus) == 31, "PROTOCOL.md: kind 5");

struct WIRE_PACKED WireFrameHeader {
    uint8_t version_kind;
    uint8_t sequence;
    uint8_t pipe;
    uint32_t receiver_time_us;
};
static_assert(sizeof(WireFrameHeader) == 7, "PROTOCOL.md: frame header");

struct WIRE_PACKED WireRadioFrame {
    WireFrameHeader header;
    uint8_t payload[WIRE_MAX_PAYLOAD];
};

// How a packet was received, by a radio that measures it.
struct WIRE_PACKED WireSignal {
    uint8_t minus_rssi_dbm;  // 0: not measured
    int8_t snr_qdb;          // quarters of a dB
};

// A radio payload, or a packet of another program, with its signal.
struct WIRE_PACKED WireSignalFrame {
    WireFrameHeader header;
    WireSignal signal;
    uint8_t payload[WIRE_MAX_FOREIGN];
};
static_assert(sizeof(WireSignalFrame) <= 72, "PROTOCOL.md: the content is at most 72 bytes");

struct WIRE_PACKED WirePipe {
    uint32_t received;
    uint32_t lost;
    uint16_t overruns;
};

struct WIRE_PACKED WireReceiverStatus {
    WireFrameHeader header;
    uint8_t channel;
    uint8_t noise_percent;
    uint16_t dropped;
    uint8_t reset_and_radio;
    WirePipe pipes[WIRE_PIPES];
};
static_assert(sizeof(WireReceiverStatus) == 72, "PROTOCOL.md: frame kind 2");

constexpr uint8_t wire_version_kind(uint8_t kind) {
    return static_cast<uint8_t>(WIRE_VERSION << 4 | kind);
}

constexpr uint8_t wire_reset_and_radio(uint8_t reset_cause, WireRadioState radio) {
    return static_cast<uint8_t>((reset_cause & 0x0F) | radio << 4);
}

constexpr uint8_t wire_vehicle_node(uint8_t vehicle_id, uint8_t node_id) {
    return static_cast<uint8_t>(vehicle_id << 3 | node_id);
}

constexpr uint8_t wire_ranges(uint8_t accel_range, uint8_t gyro_range, uint8_t mag_scale) {
    return static_cast<uint8_t>(accel_range | gyro_range << 2 | mag_scale << 4);
}
