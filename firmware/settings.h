// SPDX-License-Identifier: Apache-2.0
// Every setting of the three programs. Those marked * are also in the settings block of each image:
// here is their default, and `mavgate flash` changes them without a compiler. Each can be given on
// the make line instead:
//     make -C firmware SETTINGS="-DVEHICLE_ID=2 -DRADIO_CHANNEL=80"
// Radio settings must be the same on all boards that talk to one another.
#pragma once

#include "common/settings_block.h"

#ifndef F_CPU
#define F_CPU 16000000UL
#endif

// --- Who this is -----------------------------------------------------------------------------

// * 1 to 31; the gateway's MAVLink system id.
#ifndef VEHICLE_ID
#define VEHICLE_ID 1
#endif

// * 0 to 7, unique within the vehicle.
#ifndef IMU_NODE_ID
#define IMU_NODE_ID 0
#endif
#ifndef GPS_NODE_ID
#define GPS_NODE_ID 1
#endif

// --- Radio -----------------------------------------------------------------------------------

// * 2400 MHz plus this. 76 lies above Wi-Fi channel 11 and inside the licence-free band, which ends
// at 2483.5 MHz in most countries.
#ifndef RADIO_CHANNEL
#define RADIO_CHANNEL 76
#endif

// * 250, 1000 or 2000 kbit/s. Each step down gains about 4 to 9 dB and costs air time: 0.2 ms, 0.4 ms
// and 1.4 ms for a full payload.
#ifndef RADIO_KBPS
#define RADIO_KBPS 1000
#endif

// * Output: 0 = -18 dBm, 1 = -12, 2 = -6, 3 = 0 dBm.
#ifndef RADIO_POWER
#define RADIO_POWER 3
#endif

// * The upper four bytes of every pipe's address; another group of boards nearby takes another.
#ifndef RADIO_ADDRESS
#define RADIO_ADDRESS 0xD35AC396UL
#endif

// * The receiver's pipe that a node sends to: two pipes for each of three vehicles.
#ifndef IMU_RADIO_PIPE
#define IMU_RADIO_PIPE (((VEHICLE_ID - 1) * 2) % 6)
#endif
#ifndef GPS_RADIO_PIPE
#define GPS_RADIO_PIPE (((VEHICLE_ID - 1) * 2 + 1) % 6)
#endif

// --- LoRa radio ------------------------------------------------------------------------------

// Built with RADIO=sx1276; 0 is the nRF24L01+.
#ifndef RADIO_SX1276
#define RADIO_SX1276 0
#endif

// * Within 433.05 to 434.79, 863 to 870 or 902 to 928 MHz, by the rules of the country.
#ifndef LORA_FREQUENCY_KHZ
#define LORA_FREQUENCY_KHZ 868300UL
#endif

// * 125, 250 or 500 kHz. Half the bandwidth gains 3 dB and doubles the time on the air.
#ifndef LORA_BANDWIDTH_KHZ
#define LORA_BANDWIDTH_KHZ 250
#endif

// * Factor 7 to 10. Each step gains 2.5 dB and nearly doubles the time on the air.
#ifndef LORA_SPREADING
#define LORA_SPREADING 7
#endif

// * Coding rate 4/5 to 4/8: 5 to 8.
#ifndef LORA_CODING
#define LORA_CODING 5
#endif

// * 2 to 20 dBm, by PA_BOOST, the only output that RFM95 modules connect.
#ifndef LORA_POWER_DBM
#define LORA_POWER_DBM 14
#endif

// * Another group of boards nearby takes another; 0x34 is LoRaWAN's.
#ifndef LORA_SYNC_WORD
#define LORA_SYNC_WORD 0x12
#endif

// * 1: the receiver passes packets of other programs on, such as RadioHead's.
#ifndef LORA_FOREIGN
#define LORA_FOREIGN 0
#endif

// --- IMU node --------------------------------------------------------------------------------

// Readings of the MPU6050 per second: 1000 divided by a whole number.
#ifndef IMU_SAMPLE_HZ
#define IMU_SAMPLE_HZ (F_CPU >= 16000000UL ? 1000 : 500)
#endif

// * IMU payloads per second: 60 to 250, by LoRa 4 to 20.
#ifndef IMU_SEND_HZ
#define IMU_SEND_HZ (RADIO_SX1276 ? 10 : 100)
#endif

// * 1 sends means of the readings and leaves every filter to the gateway; 0 filters on the node.
#ifndef IMU_RAW
#define IMU_RAW 0
#endif

// Cutoff of the second-order Butterworth low-pass on the acceleration.
#ifndef ACCEL_LOWPASS_HZ
#define ACCEL_LOWPASS_HZ 10.0
#endif

// Cutoff of the first-order high-pass on the angular rate; 0 for none. It takes the gyroscope's bias
// away, and with it, slowly, the rate of a turn that lasts: a turn of 30 s loses 2 % by its end at
// 0.0001 Hz and 17 % at 0.001 Hz. The gateway learns the bias itself, at rest and from the fixes.
#ifndef GYRO_HIGHPASS_HZ
#define GYRO_HIGHPASS_HZ 0.0
#endif

// * 0 to 3: +-2, 4, 8, 16 g and +-250, 500, 1000, 2000 deg/s.
#ifndef ACCEL_RANGE
#define ACCEL_RANGE 2
#endif
#ifndef GYRO_RANGE
#define GYRO_RANGE 2
#endif

// HMC5883L gain code; 1: 1090 counts per gauss, +-1.3 gauss.
#ifndef MAG_GAIN
#define MAG_GAIN 1
#endif
#ifndef MAG_HZ
#define MAG_HZ 75
#endif

// BMP180 oversampling 0 to 3: a conversion of 4.5, 7.5, 13.5 or 25.5 ms.
#ifndef BARO_OVERSAMPLING
#define BARO_OVERSAMPLING 3
#endif
#ifndef BARO_HZ
#define BARO_HZ (RADIO_SX1276 ? 2 : 25)
#endif

// --- GPS node --------------------------------------------------------------------------------

// * 1 to 10; 10 needs GPS alone (no GLONASS) on an M8N.
#ifndef GPS_RATE_HZ
#define GPS_RATE_HZ (RADIO_SX1276 ? 1 : 5)
#endif

// The speed that is set in the GPS receiver, one that this crystal can make: 16 MHz gives 57143,
// 8 MHz 38462.
#ifndef GPS_BAUD
#define GPS_BAUD (F_CPU >= 16000000UL ? 57600UL : 38400UL)
#endif

// * UBX-CFG-NAV5: 6, 7 and 8 are airborne below 1, 2 and 4 g.
#ifndef GPS_DYNAMIC_MODEL
#define GPS_DYNAMIC_MODEL 8
#endif

// --- Receiver --------------------------------------------------------------------------------

// Exact at 8 and 16 MHz: 250000, 500000 and 1000000.
#ifndef UART_BAUD
#define UART_BAUD 500000UL
#endif

// --- What must hold --------------------------------------------------------------------------

static_assert(F_CPU == 16000000UL || F_CPU == 8000000UL, "the clock counts on 8 or 16 MHz");
static_assert(VEHICLE_ID >= 1 && VEHICLE_ID <= 31, "VEHICLE_ID is 1 to 31");
static_assert(IMU_NODE_ID >= 0 && IMU_NODE_ID <= 7, "IMU_NODE_ID is 0 to 7");
static_assert(GPS_NODE_ID >= 0 && GPS_NODE_ID <= 7, "GPS_NODE_ID is 0 to 7");
static_assert(IMU_NODE_ID != GPS_NODE_ID, "node ids are unique within a vehicle");
static_assert(RADIO_CHANNEL >= 0 && RADIO_CHANNEL <= 125, "RADIO_CHANNEL is 0 to 125");
static_assert(RADIO_KBPS == 250 || RADIO_KBPS == 1000 || RADIO_KBPS == 2000,
              "RADIO_KBPS is 250, 1000 or 2000");
static_assert(RADIO_POWER >= 0 && RADIO_POWER <= 3, "RADIO_POWER is 0 to 3");
static_assert(IMU_RADIO_PIPE <= 5 && GPS_RADIO_PIPE <= 5, "the receiver has pipes 0 to 5");
static_assert(IMU_SAMPLE_HZ >= 200 && IMU_SAMPLE_HZ <= 1000 && 1000 % (IMU_SAMPLE_HZ) == 0,
              "IMU_SAMPLE_HZ is 1000, 500, 250 or 200");
static_assert((RADIO_SX1276 ? IMU_SEND_HZ >= 4 && IMU_SEND_HZ <= 20
                            : IMU_SEND_HZ >= 60 && IMU_SEND_HZ <= 250) && IMU_SEND_HZ <= IMU_SAMPLE_HZ,
              "IMU_SEND_HZ is 60 to 250, by LoRa 4 to 20");
static_assert((LORA_FREQUENCY_KHZ >= 433050 && LORA_FREQUENCY_KHZ <= 434790) ||
              (LORA_FREQUENCY_KHZ >= 863000 && LORA_FREQUENCY_KHZ <= 870000) ||
              (LORA_FREQUENCY_KHZ >= 902000 && LORA_FREQUENCY_KHZ <= 928000),
              "LORA_FREQUENCY_KHZ is 433050 to 434790, 863000 to 870000 or 902000 to 928000");
static_assert(LORA_BANDWIDTH_KHZ == 125 || LORA_BANDWIDTH_KHZ == 250 || LORA_BANDWIDTH_KHZ == 500,
              "LORA_BANDWIDTH_KHZ is 125, 250 or 500");
static_assert(LORA_SPREADING >= 7 && LORA_SPREADING <= 10, "LORA_SPREADING is 7 to 10");
static_assert(LORA_CODING >= 5 && LORA_CODING <= 8, "LORA_CODING is 5 to 8");
static_assert(LORA_POWER_DBM >= 2 && LORA_POWER_DBM <= 20, "LORA_POWER_DBM is 2 to 20");
static_assert(ACCEL_LOWPASS_HZ * 10 <= IMU_SAMPLE_HZ,
              "ACCEL_LOWPASS_HZ is at most a tenth of IMU_SAMPLE_HZ");
static_assert(ACCEL_RANGE >= 0 && ACCEL_RANGE <= 3, "ACCEL_RANGE is 0 to 3");
static_assert(GYRO_RANGE >= 0 && GYRO_RANGE <= 3, "GYRO_RANGE is 0 to 3");
static_assert(MAG_GAIN >= 0 && MAG_GAIN <= 7, "MAG_GAIN is 0 to 7");
static_assert(MAG_HZ >= 1 && MAG_HZ <= 75, "the HMC5883L gives up to 75 readings a second");
static_assert(BARO_OVERSAMPLING >= 0 && BARO_OVERSAMPLING <= 3, "BARO_OVERSAMPLING is 0 to 3");
static_assert(BARO_HZ >= 1 && BARO_HZ <= 30, "BARO_HZ is 1 to 30");
static_assert(GPS_RATE_HZ >= 1 && GPS_RATE_HZ <= 10, "GPS_RATE_HZ is 1 to 10");

// The settings block as built.
constexpr SettingsBlock default_settings(SettingsProgram program, uint8_t node_id, uint8_t pipe) {
    return SettingsBlock{
        {'m', 'a', 'v', 'g', 'a', 't', 'e'}, SETTINGS_VERSION, program,
        static_cast<uint8_t>(F_CPU / 1000000UL), FIRMWARE_VERSION_MAJOR, FIRMWARE_VERSION_MINOR,
        VEHICLE_ID, node_id, pipe, RADIO_CHANNEL, RADIO_KBPS, RADIO_POWER, IMU_SEND_HZ,
        RADIO_ADDRESS, IMU_RAW, ACCEL_RANGE, GYRO_RANGE, GPS_RATE_HZ, GPS_DYNAMIC_MODEL,
        0, {0, 0}, RADIO_SX1276 ? SETTINGS_SX1276 : SETTINGS_NRF24, LORA_FREQUENCY_KHZ,
        LORA_BANDWIDTH_KHZ, LORA_SPREADING, LORA_CODING, LORA_POWER_DBM, LORA_SYNC_WORD, LORA_FOREIGN, 0,
    };
}
