// Any Arduino board with an MPU6050 (I2C) and an NMEA GPS receiver on Serial1: prints lines that
// `mavgate run --source lines:/dev/ttyUSB0` reads. Needs no library besides Wire.
#include <Wire.h>

const uint8_t MPU = 0x68;
const float G_PER_COUNT = 4.0 / 32768.0;     // +-4 g
const float DPS_PER_COUNT = 500.0 / 32768.0; // +-500 deg/s
const uint32_t PERIOD_US = 10000;            // 100 Hz
uint32_t next_us;

void write_register(uint8_t number, uint8_t value) {
  Wire.beginTransmission(MPU);
  Wire.write(number);
  Wire.write(value);
  Wire.endTransmission();
}

int16_t read_word() {
  uint8_t high = Wire.read();
  return (int16_t)(high << 8 | Wire.read());
}

void print_vector(const char *key, const int16_t *counts, float scale) {
  Serial.print(key);
  for (uint8_t k = 0; k < 3; k++) {
    Serial.print(counts[k] * scale, 4);
    Serial.print(k < 2 ? ',' : ']');
  }
}

void setup() {
  Serial.begin(230400);
  Serial1.begin(9600);
  Wire.begin();
  Wire.setClock(400000);
  write_register(0x6B, 1);    // awake, clock of the gyroscope
  write_register(0x1A, 3);    // 44 Hz low-pass
  write_register(0x1B, 0x08); // +-500 deg/s
  write_register(0x1C, 0x08); // +-4 g
  next_us = micros();
}

void loop() {
  static char sentence[100];
  static uint8_t length;
  while (Serial1.available()) { // a sentence is passed on whole, between two samples
    char c = Serial1.read();
    if (length < sizeof sentence) sentence[length++] = c;
    if (c == '\n') {
      Serial.write(sentence, length);
      length = 0;
    }
  }
  if ((int32_t)(micros() - next_us) < 0) return;
  next_us += PERIOD_US;
  Wire.beginTransmission(MPU);
  Wire.write(0x3B);
  Wire.endTransmission(false);
  if (Wire.requestFrom(MPU, (uint8_t)14) != 14) return;
  int16_t accel[3], gyro[3];
  for (uint8_t k = 0; k < 3; k++) accel[k] = read_word();
  read_word(); // temperature
  for (uint8_t k = 0; k < 3; k++) gyro[k] = read_word();
  Serial.print("{\"t_ms\":");
  Serial.print(micros() / 1000.0, 2);
  print_vector(",\"accel_g\":[", accel, G_PER_COUNT);
  print_vector(",\"gyro_dps\":[", gyro, DPS_PER_COUNT);
  Serial.println('}');
}
