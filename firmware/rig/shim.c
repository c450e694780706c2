/* SPDX-License-Identifier: GPL-3.0-or-later
 *
 * A thin layer between Python and libsimavr: one ATmega328P a board, with simavr 1.6's SPI, TWI
 * and UART timing mended. It is linked against libsimavr, which is under the GNU General Public
 * License version 3 or later; so this file is too:
 *
 * This program is free software: you can redistribute it and/or modify it under the terms of the
 * GNU General Public License as published by the Free Software Foundation, either version 3 of the
 * License, or (at your option) any later version. It is distributed in the hope that it will be
 * useful, but WITHOUT ANY WARRANTY; without even the implied warranty of MERCHANTABILITY or FITNESS
 * FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_spi.h>
#include <simavr/avr_twi.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_core.h>
#include <simavr/sim_io.h>
#include <simavr/sim_time.h>

enum { SUPPLY_MV = 3300, MCUSR = 0x54, UART_OUT_SIZE = 4096 };
enum { RADIO_SELECT = 1 << 2, SPI_SIZE = 65, TWI_SIZE = 32 }; /* CSN on PB2; a command and 64 bytes */
enum { TWCR_TWIE = 0, TWCR_TWEN = 2, TWCR_TWSTO = 4, TWCR_TWSTA = 5, TWCR_TWEA = 6, TWCR_TWINT = 7 };

/* A message of the bus to the model, which answers with an acknowledgement or a byte. */
enum { BUS_ADDRESS = 0, BUS_WRITE = 1, BUS_READ = 2, BUS_STOP = 3 };

typedef uint8_t (*spi_callback)(uint8_t command);
typedef uint8_t (*twi_callback)(uint8_t event, uint8_t byte);
typedef void (*pin_callback)(uint8_t port, uint8_t value);

typedef struct {
    avr_t *avr;
    avr_spi_t *spi;
    avr_twi_t *twi;
    avr_uart_t *uart;
    avr_io_write_t uart_baud_write;
    void (*core_reset)(avr_t *avr);
    spi_callback on_spi;
    twi_callback on_twi;
    pin_callback on_pin;
    uint8_t spi_answer;
    uint8_t spi_count; /* bytes since the radio was selected */
    uint8_t *spi_in;   /* those behind the command, and what the radio sends meanwhile */
    const uint8_t *spi_out;
    uint8_t port_b;
    uint8_t twi_status;    /* what the running bus action ends with */
    uint8_t twi_busy;      /* between start and stop */
    uint8_t twi_addressed; /* 0, or the read-write bit + 1 */
    uint8_t twi_stuck;     /* somebody holds SDA low */
    uint8_t twi_answer[TWI_SIZE]; /* bytes that a slave sends in one go, those left at the end */
    uint8_t twi_left;
    int64_t period_fs; /* of the crystal, with its error */
    int64_t halted_ps; /* time that passed without a cycle */
    uint8_t failed;    /* a callback met an exception */
    uint8_t line_watched; /* somebody listens: */
    uint8_t line_changed; /* bytes were sent, or the speed was set */
    uint8_t pulse_bit;    /* of port D */
    uint64_t slept;
    uint32_t resets;
    uint32_t uart_count;
    uint8_t uart_bytes[UART_OUT_SIZE];
    uint64_t uart_cycles[UART_OUT_SIZE];
} board_t;

/* simavr gives its sleep hook no parameter of ours: boards are found by their core. */
enum { MAX_BOARDS = 64 };
static board_t *boards[MAX_BOARDS];

static board_t *board_of(const avr_t *avr)
{
    for (int i = 0; i < MAX_BOARDS; i++)
        if (boards[i] && boards[i]->avr == avr)
            return boards[i];
    return NULL;
}

static void note_sleep(avr_t *avr, avr_cycle_count_t cycles)
{
    /* simavr would really sleep here. */
    board_of(avr)->slept += cycles + 1;
}

/* Any reset, the watchdog's too: the models drive their lines again. */
static void note_reset(avr_t *avr)
{
    board_t *board = board_of(avr);
    if (board->core_reset)
        board->core_reset(avr);
    board->resets++;
    board->twi_busy = board->twi_addressed = 0;
    if (board->on_pin)
        board->on_pin('R', 0);
}

static void be_silent(avr_t *avr, const int level, const char *format, va_list arguments)
{
    (void)avr, (void)level, (void)format, (void)arguments;
}

/* --- SPI: simavr takes 100 us a byte whatever the divider ----------------------------------- */

static avr_cycle_count_t spi_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    board_t *board = param;
    (void)when;
    board->spi->input_data_register = board->spi_answer;
    avr_raise_interrupt(avr, &board->spi->spi);
    return 0;
}

/* The command goes to the model, which then has its answer ready; the bytes behind it are kept. */
static uint8_t spi_exchange(board_t *board, uint8_t byte)
{
    uint8_t answer = 0;
    if (board->spi_count == 0)
        answer = board->on_spi ? board->on_spi(byte) : 0xFF;
    else if (board->spi_count < SPI_SIZE) {
        board->spi_in[board->spi_count - 1] = byte;
        answer = board->spi_out[board->spi_count - 1];
    }
    board->spi_count += board->spi_count < SPI_SIZE;
    return answer;
}

static void spi_write(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    static const uint8_t cycles_a_bit[8] = {4, 16, 64, 128, 2, 8, 32, 64};
    board_t *board = param;
    avr_core_watch_write(avr, address, value);
    if (!avr_regbit_get(avr, board->spi->spe))
        return;
    avr_clear_interrupt(avr, &board->spi->spi);
    uint8_t divider = (avr->data[board->spi->r_spcr] & 3) | (avr->data[board->spi->r_spsr] & 1) << 2;
    board->spi_answer = spi_exchange(board, value);
    avr_cycle_timer_register(avr, 8 * cycles_a_bit[divider], spi_done, board);
}

/* --- TWI: simavr runs at 1 us a bit whatever TWBR says; this is the whole master ------------- */

static avr_cycle_count_t twi_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    board_t *board = param;
    avr_twi_t *twi = board->twi;
    (void)when;
    avr->data[twi->r_twsr] = (avr->data[twi->r_twsr] & 3) | board->twi_status;
    avr_raise_interrupt(avr, &twi->twi);
    return 0;
}

static void twi_end_after(board_t *board, int bits, uint8_t status)
{
    avr_t *avr = board->avr;
    uint32_t prescaler = 1u << 2 * (avr->data[board->twi->r_twsr] & 3);
    uint32_t cycles_a_bit = 16 + 2 * avr->data[board->twi->r_twbr] * prescaler;
    board->twi_status = status;
    avr_cycle_timer_register(avr, bits * cycles_a_bit, twi_done, board);
}

static uint8_t twi_notify(board_t *board, uint8_t event, uint8_t byte)
{
    return board->on_twi ? board->on_twi(event, byte) : 0;
}

static void twi_start(board_t *board)
{
    twi_end_after(board, 2, board->twi_busy ? 0x10 : 0x08);
    board->twi_busy = 1;
    board->twi_addressed = 0;
}

static void twi_stop(board_t *board)
{
    avr_t *avr = board->avr;
    avr->data[board->twi->r_twcr] &= ~(1 << TWCR_TWSTO);
    if (board->twi_busy)
        twi_notify(board, BUS_STOP, board->twi_left);
    board->twi_left = 0;
    board->twi_busy = board->twi_addressed = 0;
}

static void twi_byte(board_t *board, int acknowledge)
{
    avr_t *avr = board->avr;
    uint8_t byte = avr->data[board->twi->r_twdr];
    if (!board->twi_addressed) {
        board->twi_left = 0;
        uint8_t ack = twi_notify(board, BUS_ADDRESS, byte);
        board->twi_addressed = 1 + (byte & 1);
        twi_end_after(board, 9, byte & 1 ? (ack ? 0x40 : 0x48) : (ack ? 0x18 : 0x20));
    } else if (board->twi_addressed == 1) {
        twi_end_after(board, 9, twi_notify(board, BUS_WRITE, byte) ? 0x28 : 0x30);
    } else {
        avr->data[board->twi->r_twdr] = board->twi_left
                                            ? board->twi_answer[TWI_SIZE - board->twi_left--]
                                            : twi_notify(board, BUS_READ, acknowledge);
        twi_end_after(board, 9, acknowledge ? 0x50 : 0x58);
    }
}

static void twi_write(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    board_t *board = param;
    uint8_t flagged = avr->data[address] & 1 << TWCR_TWINT;
    uint8_t act = value & 1 << TWCR_TWINT;
    if (act)
        avr_clear_interrupt(avr, &board->twi->twi);
    avr->data[address] = (value & ~(1 << TWCR_TWINT)) | (act ? 0 : flagged);
    if (!(value & 1 << TWCR_TWEN)) {
        avr_cycle_timer_cancel(avr, twi_done, board);
        avr->data[address] = 0;
        board->twi_busy = board->twi_addressed = 0;
        return;
    }
    if (!act)
        return;
    if (value & 1 << TWCR_TWSTO)
        twi_stop(board);
    if (board->twi_stuck)
        return; /* the bus is never free */
    if (value & 1 << TWCR_TWSTA)
        twi_start(board);
    else if (board->twi_busy)
        twi_byte(board, (value >> TWCR_TWEA) & 1);
}

/* --- UART: simavr counts eleven bits a byte -------------------------------------------------- */

static void uart_baud_write(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    board_t *board = param;
    avr_uart_t *uart = board->uart;
    board->uart_baud_write(avr, address, value, uart);
    uint32_t divisor = avr_regbit_get(avr, uart->ubrrl) | avr_regbit_get(avr, uart->ubrrh) << 8;
    uart->cycles_per_byte = (divisor + 1) * 8 * (avr_regbit_get(avr, uart->u2x) ? 1 : 2) * 10;
    board->line_changed = board->line_watched;
}

static void uart_output(struct avr_irq_t *irq, uint32_t value, void *param)
{
    board_t *board = param;
    (void)irq;
    if (board->uart_count < UART_OUT_SIZE) {
        board->uart_bytes[board->uart_count] = (uint8_t)value;
        board->uart_cycles[board->uart_count] = board->avr->cycle + board->uart->cycles_per_byte;
        board->uart_count++;
        board->line_changed = board->line_watched | (board->uart_count > UART_OUT_SIZE / 2);
    }
}

/* --- Pins ------------------------------------------------------------------------------------ */

static void port_b_changed(struct avr_irq_t *irq, uint32_t value, void *param)
{
    board_t *board = param;
    uint8_t changed = board->port_b ^ value;
    (void)irq;
    board->port_b = (uint8_t)value;
    if (changed == RADIO_SELECT && !(value & RADIO_SELECT))
        return; /* selected: the command comes next */
    if (board->on_pin)
        board->on_pin('B', (uint8_t)value);
    if (value & RADIO_SELECT)
        board->spi_count = 0;
}

static void port_c_turned(struct avr_irq_t *irq, uint32_t value, void *param)
{
    board_t *board = param;
    (void)irq;
    if (board->on_pin)
        board->on_pin('C', (uint8_t)value);
}

/* --- Boards ---------------------------------------------------------------------------------- */

static void *find_io(avr_t *avr, const char *kind)
{
    for (avr_io_t *io = avr->io_port; io; io = io->next)
        if (!strcmp(io->kind, kind))
            return io;
    return NULL;
}

static void replace_write(board_t *board, avr_io_addr_t address, avr_io_write_t write)
{
    board->avr->io[AVR_DATA_TO_IO(address)].w.c = write;
    board->avr->io[AVR_DATA_TO_IO(address)].w.param = board;
}

static void hook(board_t *board)
{
    avr_t *avr = board->avr;
    board->spi = find_io(avr, "spi");
    board->twi = find_io(avr, "twi");
    board->uart = find_io(avr, "uart");
    replace_write(board, board->spi->r_spdr, spi_write);
    replace_write(board, board->twi->r_twcr, twi_write);
    avr_io_addr_t ubrrl = board->uart->ubrrl.reg;
    board->uart_baud_write = avr->io[AVR_DATA_TO_IO(ubrrl)].w.c;
    replace_write(board, ubrrl, uart_baud_write);
    /* Or a line that is low while its interrupt has no mode yet would raise it for ever. */
    for (uint8_t line = 0; line < 2; ++line)
        avr_extint_set_strict_lvl_trig(avr, line, 0);
    uint32_t no_flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &no_flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT),
                            uart_output, board);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), IOPORT_IRQ_REG_PORT),
                            port_b_changed, board);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('C'), IOPORT_IRQ_DIRECTION_ALL),
                            port_c_turned, board);
}

board_t *board_new(uint32_t frequency_hz, int64_t period_fs)
{
    int slot = 0;
    while (slot < MAX_BOARDS && boards[slot])
        slot++;
    if (slot == MAX_BOARDS)
        return NULL;
    avr_global_logger_set(be_silent);
    board_t *board = calloc(1, sizeof *board);
    board->avr = avr_make_mcu_by_name("atmega328p");
    avr_init(board->avr);
    boards[slot] = board;
    board->avr->frequency = frequency_hz;
    board->period_fs = period_fs;
    board->avr->vcc = board->avr->avcc = SUPPLY_MV;
    board->avr->sleep = note_sleep;
    board->core_reset = board->avr->reset;
    board->avr->reset = note_reset;
    hook(board);
    return board;
}

void board_free(board_t *board)
{
    for (int i = 0; i < MAX_BOARDS; i++)
        if (boards[i] == board)
            boards[i] = NULL;
    avr_terminate(board->avr);
    free(board->avr);
    free(board);
}

void board_connect(board_t *board, spi_callback on_spi, twi_callback on_twi, pin_callback on_pin,
                   uint8_t *spi_in, const uint8_t *spi_out)
{
    board->spi_in = spi_in;
    board->spi_out = spi_out;
    board->on_spi = on_spi;
    board->on_twi = on_twi;
    board->on_pin = on_pin;
}

void board_load(board_t *board, const uint8_t *code, uint32_t size)
{
    avr_loadcode(board->avr, (uint8_t *)code, size, 0);
    board->avr->codeend = size;
    board->avr->data[MCUSR] = 1; /* power-on */
}

/* Where the chip starts after a reset: its fuses BOOTRST and BOOTSZ. */
void board_start_at(board_t *board, uint32_t address)
{
    board->avr->reset_pc = board->avr->pc = address;
}

/* Restarts the chip as the cause (bits of MCUSR) would; the cycle counter goes on. */
void board_reset(board_t *board, uint8_t cause)
{
    avr_t *avr = board->avr;
    avr_reset(avr);
    avr->data[MCUSR] = cause;
}

static avr_cycle_count_t stop_here(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr, (void)when, (void)param;
    return 0;
}

/* --- Time: a board's cycles on the time line of the bench, in ps ------------------------------ */

static int64_t time_of(const board_t *board, uint64_t cycle)
{
    return board->halted_ps + (int64_t)((unsigned __int128)cycle * board->period_fs / 1000);
}

int64_t board_now_ps(const board_t *board) { return time_of(board, board->avr->cycle); }

/* Lets time pass until then without a cycle. */
void board_halt(board_t *board, int64_t until_ps)
{
    int64_t late_ps = until_ps - board_now_ps(board);
    board->halted_ps += late_ps > 0 ? late_ps : 0;
}

void board_fail(board_t *board) { board->failed = 1; }

/* Whether the program runs, and no callback met an exception since the last call. */
int board_sound(board_t *board)
{
    int failed = board->failed, state = board->avr->state;
    board->failed = 0;
    return !failed && (state == cpu_Running || state == cpu_Sleeping);
}

static void run_to(board_t *board, int64_t until_ps)
{
    avr_t *avr = board->avr;
    int64_t left_ps = until_ps - board->halted_ps;
    if (left_ps <= 0)
        return;
    uint64_t cycle = ((unsigned __int128)left_ps * 1000 + board->period_fs - 1) / board->period_fs;
    if (avr->cycle >= cycle)
        return;
    /* A timer at the end, or a sleeping core would jump past it. */
    avr_cycle_timer_register(avr, cycle - avr->cycle, stop_here, board);
    while (avr->cycle < cycle && avr->state != cpu_Done && avr->state != cpu_Crashed)
        avr_run(avr);
    avr_cycle_timer_cancel(avr, stop_here, board);
}

/* Runs all boards in steps until a model's event is due, a serial line changes or a program ends:
 * these are for the caller. Callbacks may bring the next event forward. Returns the time reached. */
int64_t boards_run(board_t **bench, int count, int64_t now_ps, int64_t until_ps, int64_t step_ps,
                   const volatile int64_t *next_event_ps)
{
    int stop = 0;
    for (int i = 0; i < count; i++)
        bench[i]->line_changed = 0;
    while (now_ps < until_ps && !stop) {
        int64_t next_ps = now_ps + step_ps < until_ps ? now_ps + step_ps : until_ps;
        if (*next_event_ps < next_ps)
            next_ps = *next_event_ps;
        now_ps = next_ps > now_ps ? next_ps : now_ps;
        for (int i = 0; i < count; i++) {
            run_to(bench[i], now_ps);
            avr_t *avr = bench[i]->avr;
            stop |= bench[i]->line_changed | bench[i]->failed | (avr->state == cpu_Done) |
                    (avr->state == cpu_Crashed);
        }
        stop |= *next_event_ps <= now_ps;
    }
    return now_ps;
}

uint64_t board_cycle(const board_t *board) { return board->avr->cycle; }
uint64_t board_slept(const board_t *board) { return board->slept; }
uint32_t board_resets(const board_t *board) { return board->resets; }
uint32_t board_pc(const board_t *board) { return board->avr->pc; }
void board_poke(board_t *board, uint16_t address, uint8_t value) { board->avr->data[address] = value; }

uint16_t board_flash_word(const board_t *board, uint32_t address)
{
    return board->avr->flash[address] | board->avr->flash[address + 1] << 8;
}

void board_patch_flash(board_t *board, uint32_t address, uint16_t word)
{
    board->avr->flash[address] = word & 0xFF;
    board->avr->flash[address + 1] = word >> 8;
}

void board_set_pin(board_t *board, char port, uint8_t bit, uint8_t level)
{
    avr_irq_t *irq = avr_io_getirq(board->avr, AVR_IOCTL_IOPORT_GETIRQ(port), bit);
    /* After a reset the register is cleared while the line stands: simavr would filter it out. */
    irq->value = !level;
    avr_raise_irq(irq, level);
}

static avr_cycle_count_t end_pulse(avr_t *avr, avr_cycle_count_t when, void *param)
{
    board_t *board = param;
    (void)avr, (void)when;
    board_set_pin(board, 'D', board->pulse_bit, 0);
    return 0;
}

/* Drives a pin of port D high for some time. */
void board_pulse(board_t *board, uint8_t bit, uint32_t duration_us)
{
    board->pulse_bit = bit;
    board_set_pin(board, 'D', bit, 1);
    avr_cycle_timer_register_usec(board->avr, duration_us, end_pulse, board);
}

/* Bytes that the slave sends next, without being asked for each. */
void board_twi_answer(board_t *board, const uint8_t *bytes, uint8_t size)
{
    memcpy(board->twi_answer + TWI_SIZE - size, bytes, size);
    board->twi_left = size;
}

uint8_t board_spi_count(const board_t *board) { return board->spi_count; }

void board_hold_sda(board_t *board, uint8_t stuck) { board->twi_stuck = stuck; }

void board_uart_feed(board_t *board, uint8_t byte, uint8_t framing_error)
{
    avr_irq_t *irq = avr_io_getirq(board->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_raise_irq(irq, byte | (framing_error ? UART_INPUT_FE : 0));
}

/* Ends a step of `boards_run` whenever this line changes. */
void board_watch_line(board_t *board) { board->line_watched = 1; }

uint32_t board_uart_cycles_per_byte(const board_t *board)
{
    return (uint32_t)board->uart->cycles_per_byte;
}

/* Moves what was sent, and the time at which each byte's stop bit ended, to the caller. */
uint32_t board_uart_take(board_t *board, uint8_t *bytes, int64_t *ends_ps)
{
    uint32_t count = board->uart_count;
    memcpy(bytes, board->uart_bytes, count);
    for (uint32_t i = 0; i < count; i++)
        ends_ps[i] = time_of(board, board->uart_cycles[i]);
    board->uart_count = 0;
    return count;
}
