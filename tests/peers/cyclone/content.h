// The content of a message of each type, and the checksum of a received one.
#ifndef GLEANER_PEERS_CONTENT_H
#define GLEANER_PEERS_CONTENT_H

#include <stdint.h>

#include "dds/dds.h"

struct shape {
  uint32_t width, height; // of images
  uint32_t bytes;         // of compressed images and point clouds
};

struct content {
  const char *type; // as in `Imu`
  const dds_topic_descriptor_t *descriptor;
  size_t size;
  // Fills in message `n`; the memory holds message `n - 1`, or zeros.
  void (*fill)(void *message, uint32_t n, const struct shape *shape);
  uint32_t (*sum)(const void *message);
};

// The type with this name; NULL if there is none.
const struct content *content_of(const char *type);

// Every type begins with a header, whose stamp gives the number of the message.
int32_t message_sec(const void *message);
uint32_t message_nanosec(const void *message);

#endif
