// SPDX-License-Identifier: Apache-2.0
#include "hal/twi.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>
#include <util/delay.h>
#include <util/twi.h>

#include "hal/clock.h"
#include "hal/events.h"
#include "settings.h"

namespace {

constexpr uint32_t BUS_HZ = 400000;
constexpr uint8_t TWBR_VALUE = (F_CPU / BUS_HZ - 16) / 2;
// The longest transfer, 22 bytes of calibration words, takes 0.6 ms.
constexpr uint32_t TIMEOUT_US = 3000;
constexpr uint8_t SDA = 1 << PC4;
constexpr uint8_t SCL = 1 << PC5;
constexpr uint8_t RECOVERY_CLOCKS = 9;

constexpr uint8_t CONTINUE = 1 << TWINT | 1 << TWEN | 1 << TWIE;

struct Transfer {
    uint8_t address;
    uint8_t write[TWI_MAX_WRITE];
    uint8_t write_size;
    uint8_t *read;
    uint8_t read_size;
    uint8_t at;
};

// The interrupt's: the main loop touches them only while no transfer runs.
Transfer transfer;
volatile TwiState state = TWI_IDLE;

uint32_t begun_us;
uint16_t errors;

void finish(TwiState end) {
    TWCR = 1 << TWINT | 1 << TWEN | 1 << TWSTO;
    state = end;
    GPIOR0 |= EVENT_TWI;
}

void want_next_byte() {
    const bool last = transfer.at + 1 >= transfer.read_size;
    TWCR = last ? CONTINUE : static_cast<uint8_t>(CONTINUE | 1 << TWEA);
}

// Clocks a slave that holds SDA out of the byte that it still sends, then sends a stop.
void recover() {
    TWCR = 0;
    PORTC &= static_cast<uint8_t>(~(SDA | SCL));
    DDRC &= static_cast<uint8_t>(~(SDA | SCL));
    for (uint8_t i = 0; i < RECOVERY_CLOCKS && (PINC & SDA) == 0; ++i) {
        DDRC |= SCL;
        _delay_us(5);
        DDRC &= static_cast<uint8_t>(~SCL);
        _delay_us(5);
    }
    DDRC |= SDA;
    _delay_us(5);
    DDRC &= static_cast<uint8_t>(~SDA);
    _delay_us(5);
    twi_start();
}

}  // namespace

ISR(TWI_vect) {
    switch (TW_STATUS) {
        case TW_START:
        case TW_REP_START: {
            const bool reading = transfer.at >= transfer.write_size;
            TWDR = static_cast<uint8_t>(transfer.address << 1 | (reading ? TW_READ : TW_WRITE));
            TWCR = CONTINUE;
            break;
        }
        case TW_MT_SLA_ACK:
        case TW_MT_DATA_ACK:
            if (transfer.at < transfer.write_size) {
                TWDR = transfer.write[transfer.at++];
                TWCR = CONTINUE;
            } else if (transfer.read_size > 0) {
                TWCR = CONTINUE | 1 << TWSTA;
            } else {
                finish(TWI_DONE);
            }
            break;
        case TW_MR_SLA_ACK:
            transfer.at = 0;
            want_next_byte();
            break;
        case TW_MR_DATA_ACK:
            transfer.read[transfer.at++] = TWDR;
            want_next_byte();
            break;
        case TW_MR_DATA_NACK:
            transfer.read[transfer.at] = TWDR;
            finish(TWI_DONE);
            break;
        default:  // no answer, refused byte, lost arbitration, bus error
            ++errors;
            finish(TWI_FAILED);
            break;
    }
}

void twi_start() {
    PORTC |= SDA | SCL;  // the chip's weak pull-ups, in addition to those of the sensor board
    TWSR = 0;
    TWBR = TWBR_VALUE;
    TWCR = 1 << TWEN;
}

void twi_begin(uint8_t address, const uint8_t *write, uint8_t write_size, uint8_t *read,
               uint8_t read_size) {
    transfer.address = address;
    for (uint8_t i = 0; i < write_size && i < TWI_MAX_WRITE; ++i) {
        transfer.write[i] = write[i];
    }
    transfer.write_size = write_size;
    transfer.read = read;
    transfer.read_size = read_size;
    transfer.at = 0;
    begun_us = clock_us();
    state = TWI_BUSY;
    TWCR = CONTINUE | 1 << TWSTA;
}

TwiState twi_poll(uint32_t now_us) {
    if (state == TWI_BUSY && clock_passed(now_us, begun_us + TIMEOUT_US)) {
        recover();
        ++errors;
        state = TWI_FAILED;
    }
    return state;
}

bool twi_run(uint8_t address, const uint8_t *write, uint8_t write_size, uint8_t *read,
             uint8_t read_size) {
    twi_begin(address, write, write_size, read, read_size);
    while (twi_poll(clock_us()) == TWI_BUSY) {
        events_wait();  // at the latest the next tick ends it
    }
    return state == TWI_DONE;
}

bool twi_answers(uint8_t address) {
    const uint16_t before = errors;
    const uint8_t pointer[1] = {0};
    const bool answers = twi_run(address, pointer, sizeof pointer, nullptr, 0);
    errors = before;
    return answers;
}

uint16_t twi_errors() {
    uint16_t count;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { count = errors; }
    return count;
}
