#include "content.h"

#include <stdio.h>

#include "messages.h"
#include "sum.h"

typedef builtin_interfaces_msg_dds__Time_ Time;
typedef std_msgs_msg_dds__Header_ Header;
typedef sensor_msgs_msg_dds__Imu_ Imu;
typedef sensor_msgs_msg_dds__Image_ Image;
typedef sensor_msgs_msg_dds__CompressedImage_ CompressedImage;
typedef sensor_msgs_msg_dds__PointField_ PointField;
typedef sensor_msgs_msg_dds__PointCloud2_ PointCloud2;
typedef sensor_msgs_msg_dds__TimeReference_ TimeReference;
typedef dds_sequence_octet Bytes;

static void set_text(char **text, const char *value)
{
  dds_string_free(*text);
  *text = dds_string_dup(value);
}

static void set_time(Time *time, uint32_t n)
{
  time->sec = content_sec(n);
  time->nanosec = content_nanosec(n);
}

static void set_header(Header *header, uint32_t n)
{
  char frame[32];
  snprintf(frame, sizeof frame, "frame_%u", n);
  set_time(&header->stamp, n);
  set_text(&header->frame_id, frame);
}

static void set_bytes(Bytes *bytes, uint32_t n, uint32_t length)
{
  if (bytes->_length != length) {
    dds_free(bytes->_buffer);
    *bytes = (Bytes){length, length, dds_alloc(length), true};
  }
  for (uint32_t at = 0; at < length; at++)
    bytes->_buffer[at] = content_byte(n, at);
}

static uint32_t sum_time(uint32_t sum, const Time *time)
{
  return sum_u32(sum_u32(sum, (uint32_t)time->sec), time->nanosec);
}

static uint32_t sum_header(const Header *header)
{
  return sum_text(sum_time(sum_begin(), &header->stamp), header->frame_id);
}

static uint32_t sum_sequence(uint32_t sum, const Bytes *bytes)
{
  return sum_bytes(sum_u32(sum, bytes->_length), bytes->_buffer, bytes->_length);
}

// The 37 numbers after an Imu's header are contiguous, in memory and in wire format.
#define IMU_REALS 37
_Static_assert(sizeof(Imu) == sizeof(Header) + IMU_REALS * sizeof(double), "an Imu has no gaps");

static void fill_imu(void *message, uint32_t n, const struct shape *shape)
{
  (void)shape;
  Imu *imu = message;
  set_header(&imu->header, n);
  double *reals = &imu->orientation.x;
  for (int k = 0; k < IMU_REALS; k++)
    reals[k] = content_real(n, k);
}

static uint32_t sum_imu(const void *message)
{
  const Imu *imu = message;
  return sum_end(sum_bytes(sum_header(&imu->header), &imu->orientation.x, IMU_REALS * sizeof(double)));
}

static void fill_image(void *message, uint32_t n, const struct shape *shape)
{
  Image *image = message;
  set_header(&image->header, n);
  image->height = shape->height;
  image->width = shape->width;
  set_text(&image->encoding, "rgb8");
  image->is_bigendian = 0;
  image->step = 3 * shape->width;
  set_bytes((Bytes *)&image->data, n, image->step * image->height);
}

static uint32_t sum_image(const void *message)
{
  const Image *image = message;
  uint32_t sum = sum_header(&image->header);
  sum = sum_text(sum_u32(sum_u32(sum, image->height), image->width), image->encoding);
  sum = sum_u32(sum_u8(sum, image->is_bigendian), image->step);
  return sum_end(sum_sequence(sum, (const Bytes *)&image->data));
}

static void fill_compressed(void *message, uint32_t n, const struct shape *shape)
{
  CompressedImage *image = message;
  set_header(&image->header, n);
  set_text(&image->format, "jpeg");
  set_bytes((Bytes *)&image->data, n, shape->bytes);
}

static uint32_t sum_compressed(const void *message)
{
  const CompressedImage *image = message;
  return sum_end(sum_sequence(sum_text(sum_header(&image->header), image->format), (const Bytes *)&image->data));
}

static void fill_cloud(void *message, uint32_t n, const struct shape *shape)
{
  static const char *const names[] = {"x", "y", "z", "intensity"};
  PointCloud2 *cloud = message;
  set_header(&cloud->header, n);
  cloud->height = 1;
  cloud->width = shape->bytes / 16;
  if (cloud->fields._length == 0) {
    PointField *fields = dds_alloc(4 * sizeof *fields);
    for (uint32_t k = 0; k < 4; k++)
      fields[k] = (PointField){dds_string_dup(names[k]), 4 * k, 7, 1};
    cloud->fields._maximum = cloud->fields._length = 4;
    cloud->fields._buffer = fields;
    cloud->fields._release = true;
  }
  cloud->is_bigendian = false;
  cloud->point_step = 16;
  cloud->row_step = 16 * cloud->width;
  set_bytes((Bytes *)&cloud->data, n, cloud->row_step);
  cloud->is_dense = true;
}

static uint32_t sum_cloud(const void *message)
{
  const PointCloud2 *cloud = message;
  uint32_t sum = sum_u32(sum_u32(sum_header(&cloud->header), cloud->height), cloud->width);
  sum = sum_u32(sum, cloud->fields._length);
  for (uint32_t k = 0; k < cloud->fields._length; k++) {
    const PointField *field = &cloud->fields._buffer[k];
    sum = sum_u32(sum_u8(sum_u32(sum_text(sum, field->name), field->offset), field->datatype), field->count);
  }
  sum = sum_u32(sum_u32(sum_u8(sum, cloud->is_bigendian), cloud->point_step), cloud->row_step);
  return sum_end(sum_u8(sum_sequence(sum, (const Bytes *)&cloud->data), cloud->is_dense));
}

static void fill_reference(void *message, uint32_t n, const struct shape *shape)
{
  (void)shape;
  TimeReference *reference = message;
  set_header(&reference->header, n);
  set_time(&reference->time_ref, n + 1);
  set_text(&reference->source, "gps");
}

static uint32_t sum_reference(const void *message)
{
  const TimeReference *reference = message;
  return sum_end(sum_text(sum_time(sum_header(&reference->header), &reference->time_ref), reference->source));
}

static const struct content contents[] = {
  {"Imu", &sensor_msgs_msg_dds__Imu__desc, sizeof(Imu), fill_imu, sum_imu},
  {"Image", &sensor_msgs_msg_dds__Image__desc, sizeof(Image), fill_image, sum_image},
  {"CompressedImage", &sensor_msgs_msg_dds__CompressedImage__desc, sizeof(CompressedImage), fill_compressed, sum_compressed},
  {"PointCloud2", &sensor_msgs_msg_dds__PointCloud2__desc, sizeof(PointCloud2), fill_cloud, sum_cloud},
  {"TimeReference", &sensor_msgs_msg_dds__TimeReference__desc, sizeof(TimeReference), fill_reference, sum_reference},
};

const struct content *content_of(const char *type)
{
  for (size_t k = 0; k < sizeof contents / sizeof *contents; k++)
    if (strcmp(contents[k].type, type) == 0)
      return &contents[k];
  return NULL;
}

int32_t message_sec(const void *message) { return ((const Header *)message)->stamp.sec; }
uint32_t message_nanosec(const void *message) { return ((const Header *)message)->stamp.nanosec; }
