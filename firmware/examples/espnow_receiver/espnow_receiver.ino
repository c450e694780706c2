// An ESP32 on the ground: prints each ESP-NOW packet as a line for
// `mavgate run --source lines:/dev/ttyUSB0`, and its signal as a line of its own.
// The tracker sends JSON objects or NMEA sentences, at most 250 bytes each, on the same channel.
// Not compiled by the project's tests: the core for ESP32 (version 3) is not part of them.
#include <WiFi.h>
#include <esp_now.h>
#include <esp_wifi.h>

const uint8_t CHANNEL = 1;
const uint8_t TRACKER[6] = {0x24, 0x6F, 0x28, 0x00, 0x00, 0x01}; // others are ignored

void receive(const esp_now_recv_info_t *info, const uint8_t *packet, int length) {
  if (memcmp(info->src_addr, TRACKER, sizeof TRACKER) != 0) return;
  Serial.write(packet, length);
  Serial.printf("\n{\"rssi_dbm\":%d}\n", info->rx_ctrl->rssi);
}

void setup() {
  Serial.begin(230400);
  WiFi.mode(WIFI_STA);
  esp_wifi_set_channel(CHANNEL, WIFI_SECOND_CHAN_NONE);
  if (esp_now_init() != ESP_OK || esp_now_register_recv_cb(receive) != ESP_OK) {
    Serial.println("# no radio");
  }
}

void loop() { delay(1000); }
