// A peer on Fast DDS: writes or reads one topic, and prints events as lines of JSON.
//
//   fast-peer pub|sub Imu|Image|CompressedImage|PointCloud2 TOPIC [--count N] [--rate HZ]
//             [--size WxH|BYTES] [--depth N] [--readers N]
//             [--reliability reliable|best_effort] [--durability volatile|transient_local]
//
// `pub` waits for N readers (1), writes N messages (0: without end) and stays; `sub` reads. Both end
// with their standard input. With a depth of 0, all messages are kept; then `pub` also prints each
// change of the number of readers, and whether these acknowledge all messages within 20 s.
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <memory>
#include <string>
#include <thread>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

#include "messagesPubSubTypes.h"
#include "stdin.h"
#include "sum.h"

using namespace eprosima::fastdds::dds;
using std_msgs::msg::dds_::Header_;
using sensor_msgs::msg::dds_::CompressedImage_;
using sensor_msgs::msg::dds_::Image_;
using sensor_msgs::msg::dds_::Imu_;
using sensor_msgs::msg::dds_::PointCloud2_;

namespace {

struct Options {
  std::string type, topic;
  uint32_t count = 0, readers = 1, width = 64, height = 48, bytes = 1024;
  int32_t depth = 10;
  double rate = 10;
  bool reliable = true, is_volatile = true;
};

[[noreturn]] void refuse(const std::string &what)
{
  std::fprintf(stderr, "fast-peer: %s\n", what.c_str());
  std::exit(2);
}

void need(bool holds, const char *what)
{
  if (!holds)
    refuse(what);
}

Options parse(int argc, char **argv)
{
  need(argc >= 4 && argc % 2 == 0, "usage: fast-peer pub|sub TYPE TOPIC [--OPTION VALUE]...");
  Options o;
  o.type = argv[2];
  o.topic = argv[3];
  for (int k = 4; k < argc; k += 2) {
    const std::string name = argv[k], value = argv[k + 1];
    if (name == "--count")
      o.count = std::stoul(value);
    else if (name == "--readers")
      o.readers = std::stoul(value);
    else if (name == "--depth")
      o.depth = std::stoi(value);
    else if (name == "--rate")
      o.rate = std::stod(value);
    else if (name == "--size")
      need(std::sscanf(value.c_str(), "%ux%u", &o.width, &o.height) == 2 || std::sscanf(value.c_str(), "%u", &o.bytes) == 1,
           "--size is WxH or a number of bytes");
    else if (name == "--reliability")
      o.reliable = value == "reliable";
    else if (name == "--durability")
      o.is_volatile = value == "volatile";
    else
      refuse("no option " + name);
  }
  return o;
}

void set_header(Header_ &header, uint32_t n)
{
  header.stamp().sec(content_sec(n));
  header.stamp().nanosec(content_nanosec(n));
  header.frame_id("frame_" + std::to_string(n));
}

uint32_t sum_header(const Header_ &header)
{
  uint32_t sum = sum_u32(sum_begin(), static_cast<uint32_t>(header.stamp().sec()));
  return sum_text(sum_u32(sum, header.stamp().nanosec()), header.frame_id().c_str());
}

// Calls `visit` with each of an Imu's 37 numbers, in wire order.
template <typename Message, typename Visit>
void each_real(Message &imu, Visit visit)
{
  const auto vector = [&](auto &v) { visit(v.x()), visit(v.y()), visit(v.z()); };
  const auto matrix = [&](auto &m) {
    for (auto &value : m)
      visit(value);
  };
  vector(imu.orientation());
  visit(imu.orientation().w());
  matrix(imu.orientation_covariance());
  vector(imu.angular_velocity());
  matrix(imu.angular_velocity_covariance());
  vector(imu.linear_acceleration());
  matrix(imu.linear_acceleration_covariance());
}

void fill(Imu_ &imu, uint32_t n, const Options &)
{
  set_header(imu.header(), n);
  int k = 0;
  each_real(imu, [&](double &value) { value = content_real(n, k++); });
}

uint32_t sum(const Imu_ &imu)
{
  uint32_t sum = sum_header(imu.header());
  each_real(imu, [&](double value) { sum = sum_f64(sum, value); });
  return sum_end(sum);
}

template <typename Bytes>
void set_bytes(Bytes &bytes, uint32_t n, size_t length)
{
  bytes.resize(length);
  size_t at = 0;
  for (uint8_t &byte : bytes)
    byte = content_byte(n, at++);
}

template <typename Bytes>
uint32_t sum_sequence(uint32_t sum, const Bytes &bytes)
{
  return sum_bytes(sum_u32(sum, static_cast<uint32_t>(bytes.size())), bytes.data(), bytes.size());
}

void fill(Image_ &image, uint32_t n, const Options &o)
{
  set_header(image.header(), n);
  image.height(o.height);
  image.width(o.width);
  image.encoding("rgb8");
  image.is_bigendian(0);
  image.step(3 * o.width);
  set_bytes(image.data(), n, size_t{image.step()} * o.height);
}

uint32_t sum(const Image_ &image)
{
  uint32_t sum = sum_u32(sum_u32(sum_header(image.header()), image.height()), image.width());
  sum = sum_u32(sum_u8(sum_text(sum, image.encoding().c_str()), image.is_bigendian()), image.step());
  return sum_end(sum_sequence(sum, image.data()));
}

void fill(CompressedImage_ &image, uint32_t n, const Options &o)
{
  set_header(image.header(), n);
  image.format("jpeg");
  set_bytes(image.data(), n, o.bytes);
}

uint32_t sum(const CompressedImage_ &image)
{
  return sum_end(sum_sequence(sum_text(sum_header(image.header()), image.format().c_str()), image.data()));
}

void fill(PointCloud2_ &cloud, uint32_t n, const Options &o)
{
  static const char *const names[] = {"x", "y", "z", "intensity"};
  set_header(cloud.header(), n);
  cloud.height(1);
  cloud.width(o.bytes / 16);
  cloud.fields().resize(4);
  for (uint32_t k = 0; k < 4; k++) {
    auto &field = cloud.fields()[k];
    field.name(names[k]);
    field.offset(4 * k);
    field.datatype(7);
    field.count(1);
  }
  cloud.is_bigendian(false);
  cloud.point_step(16);
  cloud.row_step(16 * cloud.width());
  set_bytes(cloud.data(), n, cloud.row_step());
  cloud.is_dense(true);
}

uint32_t sum(const PointCloud2_ &cloud)
{
  uint32_t sum = sum_u32(sum_u32(sum_header(cloud.header()), cloud.height()), cloud.width());
  sum = sum_u32(sum, static_cast<uint32_t>(cloud.fields().size()));
  for (const auto &field : cloud.fields())
    sum = sum_u32(sum_u8(sum_u32(sum_text(sum, field.name().c_str()), field.offset()), field.datatype()), field.count());
  sum = sum_u32(sum_u32(sum_u8(sum, cloud.is_bigendian()), cloud.point_step()), cloud.row_step());
  return sum_end(sum_u8(sum_sequence(sum, cloud.data()), cloud.is_dense()));
}

template <typename Qos>
void set_qos(Qos &qos, const Options &o)
{
  qos.reliability().kind = o.reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
  qos.durability().kind = o.is_volatile ? VOLATILE_DURABILITY_QOS : TRANSIENT_LOCAL_DURABILITY_QOS;
  qos.history().kind = o.depth > 0 ? KEEP_LAST_HISTORY_QOS : KEEP_ALL_HISTORY_QOS;
  if (o.depth > 0)
    qos.history().depth = o.depth;
  // As rmw_fastrtps does: memory grows with the messages, whose maximum size is not known.
  qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
}

template <typename Message>
void publish(DomainParticipant *participant, Topic *topic, const Options &o)
{
  DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
  set_qos(qos, o);
  DataWriter *writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, qos);
  need(writer != nullptr, "no writer");
  PublicationMatchedStatus matched;
  do {
    if (stdin_ended(2))
      return;
    writer->get_publication_matched_status(matched);
  } while (matched.current_count < static_cast<int32_t>(o.readers));
  std::printf("{\"event\":\"matched\",\"count\":%d}\n", matched.current_count);
  const auto message = std::make_unique<Message>();
  auto due = std::chrono::steady_clock::now();
  for (uint32_t n = 1; o.count == 0 || n <= o.count; n++) {
    fill(*message, n, o);
    std::this_thread::sleep_until(due);
    due += std::chrono::nanoseconds(static_cast<int64_t>(1e9 / o.rate));
    need(writer->write(message.get()), "cannot write");
    const int32_t before = matched.current_count;
    writer->get_publication_matched_status(matched);
    if (o.depth == 0 && matched.current_count != before) {
      std::printf("{\"event\":\"matched\",\"count\":%d}\n", matched.current_count);
      const bool all = writer->wait_for_acknowledgments({20, 0}) == ReturnCode_t::RETCODE_OK;
      std::printf("{\"event\":\"acked\",\"all\":%s}\n", all ? "true" : "false");
    }
    if (stdin_ended(0))
      return;
  }
  std::printf("{\"event\":\"written\",\"count\":%u}\n", o.count);
  while (!stdin_ended(1000)) {
  }
}

template <typename Message>
void subscribe(DomainParticipant *participant, Topic *topic, const Options &o)
{
  DataReaderQos qos = DATAREADER_QOS_DEFAULT;
  set_qos(qos, o);
  DataReader *reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, qos);
  need(reader != nullptr, "no reader");
  const auto message = std::make_unique<Message>();
  int32_t writers = 0;
  while (!stdin_ended(1)) {
    SubscriptionMatchedStatus matched;
    reader->get_subscription_matched_status(matched);
    if (matched.current_count != writers)
      std::printf("{\"event\":\"matched\",\"count\":%d}\n", writers = matched.current_count);
    SampleInfo info;
    while (reader->take_next_sample(message.get(), &info) == ReturnCode_t::RETCODE_OK) {
      if (!info.valid_data)
        continue;
      const auto &stamp = message->header().stamp();
      std::printf("{\"event\":\"sample\",\"seq\":%d,\"stamp\":%lld,\"sum\":%u}\n", stamp.sec() - 1000,
                  stamp.sec() * 1000000000LL + stamp.nanosec(), sum(*message));
    }
  }
}

template <typename Message, typename Support>
void run(const std::string &how, const Options &o)
{
  auto *factory = DomainParticipantFactory::get_instance();
  DomainParticipant *participant = factory->create_participant(0, PARTICIPANT_QOS_DEFAULT);
  need(participant != nullptr, "no participant");
  TypeSupport type(new Support());
  // rmw_fastrtps registers its types by name only.
  type->auto_fill_type_information(false);
  type->auto_fill_type_object(false);
  type.register_type(participant);
  Topic *topic = participant->create_topic("rt" + o.topic, type.get_type_name(), TOPIC_QOS_DEFAULT);
  need(topic != nullptr, "no topic");
  if (how == "pub")
    publish<Message>(participant, topic, o);
  else
    subscribe<Message>(participant, topic, o);
  participant->delete_contained_entities();
  factory->delete_participant(participant);
}

} // namespace

int main(int argc, char **argv)
{
  const Options o = parse(argc, argv);
  std::setvbuf(stdout, nullptr, _IOLBF, 0);
  if (o.type == "Imu")
    run<Imu_, sensor_msgs::msg::dds_::Imu_PubSubType>(argv[1], o);
  else if (o.type == "Image")
    run<Image_, sensor_msgs::msg::dds_::Image_PubSubType>(argv[1], o);
  else if (o.type == "CompressedImage")
    run<CompressedImage_, sensor_msgs::msg::dds_::CompressedImage_PubSubType>(argv[1], o);
  else if (o.type == "PointCloud2")
    run<PointCloud2_, sensor_msgs::msg::dds_::PointCloud2_PubSubType>(argv[1], o);
  else
    refuse("no type " + o.type);
  return 0;
}
