// Reads the messages of nodes on ros_discovery_info, as a ROS 2 node on Cyclone DDS does, and prints
// them as lines of JSON.
// Built once for each size of a Gid. Ends with its standard input.
#include <stdio.h>
#include <stdlib.h>

#include "dds/dds.h"
#include "graph.h"
#include "stdin.h"

typedef rmw_dds_common_msg_dds__ParticipantEntitiesInfo_ Participant;
typedef rmw_dds_common_msg_dds__NodeEntitiesInfo_ Node;
typedef rmw_dds_common_msg_dds__Gid_ Gid;

static void print_gid(const Gid *gid)
{
  putchar('"');
  for (size_t at = 0; at < sizeof gid->data; at++)
    printf("%02x", gid->data[at]);
  putchar('"');
}

static void print_gids(const char *name, const Gid *gids, uint32_t count)
{
  printf(",\"%s\":[", name);
  for (uint32_t k = 0; k < count; k++) {
    if (k > 0)
      putchar(',');
    print_gid(&gids[k]);
  }
  putchar(']');
}

static void print_participant(const Participant *participant)
{
  printf("{\"event\":\"graph\",\"gid\":");
  print_gid(&participant->gid);
  printf(",\"nodes\":[");
  for (uint32_t k = 0; k < participant->node_entities_info_seq._length; k++) {
    const Node *node = &participant->node_entities_info_seq._buffer[k];
    printf("%s{\"namespace\":\"%s\",\"name\":\"%s\"", k > 0 ? "," : "", node->node_namespace, node->node_name);
    print_gids("readers", node->reader_gid_seq._buffer, node->reader_gid_seq._length);
    print_gids("writers", node->writer_gid_seq._buffer, node->writer_gid_seq._length);
    putchar('}');
  }
  printf("]}\n");
}

// Announces itself as a node would: others detect the size of a Gid by this message.
static void introduce(dds_entity_t writer)
{
  Node node = {.node_namespace = "/", .node_name = "peer"};
  Participant participant = {.node_entities_info_seq = {1, 1, &node, false}};
  for (size_t at = 0; at < sizeof participant.gid.data; at++)
    participant.gid.data[at] = at < 16 ? (uint8_t)(at + 1) : 0;
  dds_write(writer, &participant);
}

int main(void)
{
  setvbuf(stdout, NULL, _IOLBF, 0);
  dds_entity_t participant = dds_create_participant(DDS_DOMAIN_DEFAULT, NULL, NULL);
  const dds_topic_descriptor_t *type = &rmw_dds_common_msg_dds__ParticipantEntitiesInfo__desc;
  dds_entity_t topic = dds_create_topic(participant, type, "ros_discovery_info", NULL, NULL);
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_SECS(10));
  dds_qset_durability(qos, DDS_DURABILITY_TRANSIENT_LOCAL);
  dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, 1);
  dds_entity_t writer = dds_create_writer(participant, topic, qos, NULL);
  dds_qset_history(qos, DDS_HISTORY_KEEP_ALL, 0);
  // Its own messages are not received.
  dds_qset_ignorelocal(qos, DDS_IGNORELOCAL_PARTICIPANT);
  dds_entity_t reader = dds_create_reader(participant, topic, qos, NULL);
  if (writer < 0 || reader < 0) {
    fprintf(stderr, "cyclone-graph: no reader or writer\n");
    return 2;
  }
  introduce(writer);
  while (!stdin_ended(10)) {
    void *message = NULL;
    dds_sample_info_t info;
    while (dds_take(reader, &message, &info, 1, 1) > 0) {
      if (info.valid_data)
        print_participant(message);
      dds_return_loan(reader, &message, 1);
      message = NULL;
    }
  }
  dds_delete(participant);
  return 0;
}
