// What a message of each type holds, and the sum of one that was received.
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
  // Makes message `n` of what may be message `n - 1`, or zeros.
  void (*fill)(void *message, uint32_t n, const struct shape *shape);
  uint32_t (*sum)(const void *message);
};

// The type of that name; NULL if there is none.
const struct content *content_of(const char *type);

// Every type here begins with a header: its stamp tells which message it is.
int32_t message_sec(const void *message);
uint32_t message_nanosec(const void *message);

#endif
