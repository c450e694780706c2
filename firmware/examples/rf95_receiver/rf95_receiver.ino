// A LoRa board on the ground with the RadioHead library (RH_RF95): prints each received packet as a
// line for `mavgate run --source lines:/dev/ttyUSB0`, and the signal as a line of its own.
// The tracker sends JSON objects or NMEA sentences, at most 251 bytes each.
// Not compiled by the project's tests: RadioHead is not part of them.
#include <RH_RF95.h>
#include <SPI.h>

RH_RF95 radio(10, 2); // chip select, DIO0

void setup() {
  Serial.begin(115200);
  if (!radio.init() || !radio.setFrequency(868.1)) Serial.println("# no radio");
}

void loop() {
  uint8_t packet[RH_RF95_MAX_MESSAGE_LEN], length = sizeof packet;
  if (!radio.available() || !radio.recv(packet, &length)) return;
  Serial.write(packet, length);
  Serial.print("\n{\"rssi_dbm\":");
  Serial.print(radio.lastRssi());
  Serial.print(",\"snr_db\":");
  Serial.print(radio.lastSNR());
  Serial.println('}');
}
