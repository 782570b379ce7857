// A peer on Cyclone DDS: writes or reads one topic, and prints events as lines of JSON.
//
//   cyclone-peer pub|sub TYPE TOPIC [--count N] [--rate HZ] [--size WxH|BYTES] [--depth N]
//                [--readers N] [--reliability reliable|best_effort]
//                [--durability volatile|transient_local]
//
// `pub` waits for N readers (1), writes N messages (0: without end) and stays; `sub` reads. Both end
// with their standard input. With a depth of 0, all messages are kept; then `pub` also prints each
// change of the number of readers, and whether these acknowledge all messages within 20 s.
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "content.h"
#include "stdin.h"

struct options {
  const struct content *content;
  const char *topic;
  uint32_t count, readers;
  int32_t depth;
  double rate;
  struct shape shape;
  dds_reliability_kind_t reliability;
  dds_durability_kind_t durability;
};

static void need(bool holds, const char *what)
{
  if (holds)
    return;
  fprintf(stderr, "cyclone-peer: %s\n", what);
  exit(2);
}

static struct options parse(int argc, char **argv)
{
  need(argc >= 4 && argc % 2 == 0, "usage: cyclone-peer pub|sub TYPE TOPIC [--OPTION VALUE]...");
  struct options o = {.content = content_of(argv[2]), .topic = argv[3], .count = 0, .readers = 1, .depth = 10, .rate = 10};
  need(o.content != NULL, "no such type");
  o.shape = (struct shape){.width = 64, .height = 48, .bytes = 1024};
  o.reliability = DDS_RELIABILITY_RELIABLE;
  o.durability = DDS_DURABILITY_VOLATILE;
  for (int k = 4; k < argc; k += 2) {
    const char *name = argv[k], *value = argv[k + 1];
    if (strcmp(name, "--count") == 0)
      o.count = (uint32_t)strtoul(value, NULL, 10);
    else if (strcmp(name, "--readers") == 0)
      o.readers = (uint32_t)strtoul(value, NULL, 10);
    else if (strcmp(name, "--depth") == 0)
      o.depth = (int32_t)strtol(value, NULL, 10);
    else if (strcmp(name, "--rate") == 0)
      o.rate = strtod(value, NULL);
    else if (strcmp(name, "--size") == 0) {
      if (sscanf(value, "%ux%u", &o.shape.width, &o.shape.height) != 2)
        o.shape.bytes = (uint32_t)strtoul(value, NULL, 10);
    } else if (strcmp(name, "--reliability") == 0)
      o.reliability = strcmp(value, "reliable") == 0 ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT;
    else if (strcmp(name, "--durability") == 0)
      o.durability = strcmp(value, "volatile") == 0 ? DDS_DURABILITY_VOLATILE : DDS_DURABILITY_TRANSIENT_LOCAL;
    else
      need(false, "no such option");
  }
  return o;
}

static void publish(dds_entity_t writer, const struct options *o)
{
  dds_publication_matched_status_t matched = {0};
  do {
    if (stdin_ended(2))
      return;
    need(dds_get_publication_matched_status(writer, &matched) == DDS_RETCODE_OK, "no status");
  } while (matched.current_count < o->readers);
  printf("{\"event\":\"matched\",\"count\":%u}\n", matched.current_count);
  void *message = calloc(1, o->content->size);
  dds_time_t due = dds_time();
  for (uint32_t n = 1; o->count == 0 || n <= o->count; n++) {
    o->content->fill(message, n, &o->shape);
    dds_time_t now = dds_time();
    if (due > now)
      dds_sleepfor(due - now);
    due += (dds_duration_t)(1e9 / o->rate);
    need(dds_write(writer, message) == DDS_RETCODE_OK, "cannot write");
    const uint32_t before = matched.current_count;
    need(dds_get_publication_matched_status(writer, &matched) == DDS_RETCODE_OK, "no status");
    if (o->depth == 0 && matched.current_count != before) {
      printf("{\"event\":\"matched\",\"count\":%u}\n", matched.current_count);
      bool all = dds_wait_for_acks(writer, DDS_SECS(20)) == DDS_RETCODE_OK;
      printf("{\"event\":\"acked\",\"all\":%s}\n", all ? "true" : "false");
    }
    if (stdin_ended(0))
      return;
  }
  printf("{\"event\":\"written\",\"count\":%u}\n", o->count);
  while (!stdin_ended(1000)) {
  }
}

static void subscribe(dds_entity_t reader, const struct options *o)
{
  uint32_t writers = 0;
  while (!stdin_ended(1)) {
    dds_subscription_matched_status_t matched = {0};
    need(dds_get_subscription_matched_status(reader, &matched) == DDS_RETCODE_OK, "no status");
    if (matched.current_count != writers)
      printf("{\"event\":\"matched\",\"count\":%u}\n", writers = matched.current_count);
    void *message = NULL;
    dds_sample_info_t info;
    while (dds_take(reader, &message, &info, 1, 1) > 0) {
      if (info.valid_data) {
        int32_t sec = message_sec(message);
        printf("{\"event\":\"sample\",\"seq\":%d,\"stamp\":%lld,\"sum\":%u}\n", sec - 1000,
               (long long)sec * 1000000000 + message_nanosec(message), o->content->sum(message));
      }
      dds_return_loan(reader, &message, 1);
      message = NULL;
    }
  }
}

int main(int argc, char **argv)
{
  struct options o = parse(argc, argv);
  setvbuf(stdout, NULL, _IOLBF, 0);
  dds_entity_t participant = dds_create_participant(DDS_DOMAIN_DEFAULT, NULL, NULL);
  need(participant > 0, "no participant");
  char name[256];
  snprintf(name, sizeof name, "rt%s", o.topic);
  dds_entity_t topic = dds_create_topic(participant, o.content->descriptor, name, NULL, NULL);
  need(topic > 0, "no topic");
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, o.reliability, DDS_SECS(10));
  dds_qset_durability(qos, o.durability);
  dds_history_kind_t history = o.depth > 0 ? DDS_HISTORY_KEEP_LAST : DDS_HISTORY_KEEP_ALL;
  dds_qset_history(qos, history, o.depth);
  // The history for late readers is the same, as in rmw_cyclonedds.
  dds_qset_durability_service(qos, 0, history, o.depth, DDS_LENGTH_UNLIMITED, DDS_LENGTH_UNLIMITED, DDS_LENGTH_UNLIMITED);
  if (strcmp(argv[1], "pub") == 0) {
    dds_entity_t writer = dds_create_writer(participant, topic, qos, NULL);
    need(writer > 0, "no writer");
    publish(writer, &o);
  } else {
    dds_entity_t reader = dds_create_reader(participant, topic, qos, NULL);
    need(reader > 0, "no reader");
    subscribe(reader, &o);
  }
  dds_delete(participant);
  return 0;
}
