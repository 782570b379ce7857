// The checksum of a message that both ends print: CRC-32 of its fields in wire order, little-endian,
// without padding; a string is its length with the zero, its characters and the zero, a sequence its
// length and its elements.
#ifndef GLEANER_PEERS_SUM_H
#define GLEANER_PEERS_SUM_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

static inline uint32_t sum_begin(void) { return 0xffffffffu; }

static inline uint32_t sum_bytes(uint32_t sum, const void *data, size_t length)
{
  static uint32_t table[256];
  if (table[1] == 0)
    for (uint32_t n = 0; n < 256; n++) {
      uint32_t c = n;
      for (int bit = 0; bit < 8; bit++)
        c = (c & 1) ? 0xedb88320u ^ (c >> 1) : c >> 1;
      table[n] = c;
    }
  const uint8_t *byte = (const uint8_t *)data;
  for (size_t at = 0; at < length; at++)
    sum = table[(sum ^ byte[at]) & 0xff] ^ (sum >> 8);
  return sum;
}

// Peers run on little-endian machines: memory and wire format are the same.
static inline uint32_t sum_u8(uint32_t sum, uint8_t value) { return sum_bytes(sum, &value, 1); }
static inline uint32_t sum_u32(uint32_t sum, uint32_t value) { return sum_bytes(sum, &value, 4); }
static inline uint32_t sum_f64(uint32_t sum, double value) { return sum_bytes(sum, &value, 8); }

static inline uint32_t sum_text(uint32_t sum, const char *text)
{
  uint32_t length = (uint32_t)strlen(text) + 1;
  return sum_bytes(sum_u32(sum, length), text, length);
}

static inline uint32_t sum_end(uint32_t sum) { return ~sum; }

// The content of a message follows from its number: see tests/src/peers/message.rs.
static inline int32_t content_sec(uint32_t n) { return (int32_t)(1000 + n); }
static inline uint32_t content_nanosec(uint32_t n) { return 7 * n + 3; }
static inline uint8_t content_byte(uint32_t n, size_t at) { return (uint8_t)(31 * at + 7 * n); }
static inline double content_real(uint32_t n, int k) { return 100.0 * n + k + 0.25; }

#endif
