//! The connections of several processes over one database: to a bus, and to a bucket of files.

mod nats;
mod s3;

pub(crate) use nats::BusAddress;
pub(crate) use s3::S3Bucket;
