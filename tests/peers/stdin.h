// Peers end when their standard input ends: when the program that started them ends or closes it.
#ifndef GLEANER_PEERS_STDIN_H
#define GLEANER_PEERS_STDIN_H

#include <poll.h>
#include <unistd.h>

// Waits for at most `ms`; returns whether standard input has ended.
static inline int stdin_ended(int ms)
{
  struct pollfd in = {.fd = 0, .events = POLLIN, .revents = 0};
  char rest[64];
  return poll(&in, 1, ms) > 0 && read(0, rest, sizeof rest) <= 0;
}

#endif
