//! `gleaner:lambda/data` and `types` over [`api::data`](crate::api::data) and
//! [`api::frame`](crate::api::frame).

use bytes::Bytes;
use wasmtime::component::{Linker, Resource};

use super::Hosted;
use super::bindings::gleaner::lambda::data::{Host, HostField, HostFrame, HostSample, HostTopic};
use super::bindings::gleaner::lambda::types::{
    self, Column, Counts, DataError, Encoding, FrameInfo, Guid, Identity, Roi, Stamps, Value,
};
use super::bindings::handles::{Field, Frame, Sample, Topic};
use crate::api::data::DataErrorKind as Kind;
use crate::api::{data, frame};
use gleaner_pixels as image;

/// Name of the interface, as in `wit/`.
const DATA: &str = "gleaner:lambda/data@0.1.0";

type DataResult<T> = wasmtime::Result<Result<T, DataError>>;

impl types::Host for Hosted {}

impl Host for Hosted {
    fn input(&mut self, name: String) -> DataResult<Resource<Topic>> {
        let input = self.session.input(&name);
        self.push_result(input)
    }

    fn inputs(&mut self) -> wasmtime::Result<Vec<String>> {
        Ok(self.session.input_names()?)
    }

    fn now_ns(&mut self) -> wasmtime::Result<i64> {
        self.session.fuel().charge_call()?;
        Ok(self.session.now_ns())
    }
}

impl HostTopic for Hosted {
    fn name(&mut self, topic: Resource<Topic>) -> wasmtime::Result<String> {
        Ok(self.resolve(&topic)?.name().to_owned())
    }

    fn ros_topic(&mut self, topic: Resource<Topic>) -> wasmtime::Result<String> {
        Ok(self.resolve(&topic)?.ros_topic().to_owned())
    }

    fn type_name(&mut self, topic: Resource<Topic>) -> wasmtime::Result<String> {
        Ok(self.resolve(&topic)?.type_name().to_owned())
    }

    fn newest(&mut self, topic: Resource<Topic>) -> wasmtime::Result<Option<Resource<Sample>>> {
        let newest = self.resolve(&topic)?.newest()?;
        newest.map(|sample| Ok(self.handles.push(sample)?)).transpose()
    }

    fn last(&mut self, topic: Resource<Topic>, n: u32) -> wasmtime::Result<Vec<Resource<Sample>>> {
        let samples = self.handles.get(&topic)?.last(n as usize)?;
        self.push_all(samples)
    }

    fn since(
        &mut self,
        topic: Resource<Topic>,
        since_ns: i64,
    ) -> wasmtime::Result<Vec<Resource<Sample>>> {
        let samples = self.handles.get(&topic)?.since(since_ns)?;
        self.push_all(samples)
    }

    fn counts(&mut self, topic: Resource<Topic>) -> wasmtime::Result<Counts> {
        let data::Counts { received, lost, overwritten, no_slot, too_big, skipped } =
            self.resolve(&topic)?.counts();
        Ok(Counts { received, lost, overwritten, no_slot, too_big, skipped })
    }

    fn field(&mut self, topic: Resource<Topic>, path: String) -> DataResult<Resource<Field>> {
        let field = self.handles.get(&topic)?.field(&path);
        self.push_result(field)
    }

    fn column(
        &mut self,
        topic: Resource<Topic>,
        field: Resource<Field>,
        n: u32,
    ) -> DataResult<Column> {
        let (topic, field) = (self.handles.get(&topic)?, self.handles.get(&field)?);
        wit_result(topic.column(field, n as usize).map(column_out))
    }

    fn column_since(
        &mut self,
        topic: Resource<Topic>,
        field: Resource<Field>,
        since_ns: i64,
    ) -> DataResult<Column> {
        let (topic, field) = (self.handles.get(&topic)?, self.handles.get(&field)?);
        wit_result(topic.column_since(field, since_ns).map(column_out))
    }

    fn drop(&mut self, topic: Resource<Topic>) -> wasmtime::Result<()> {
        self.handles.delete(topic)?;
        Ok(())
    }
}

impl HostField for Hosted {
    fn path(&mut self, field: Resource<Field>) -> wasmtime::Result<String> {
        Ok(self.resolve(&field)?.path().to_owned())
    }

    fn drop(&mut self, field: Resource<Field>) -> wasmtime::Result<()> {
        self.handles.delete(field)?;
        Ok(())
    }
}

impl HostSample for Hosted {
    fn identity(&mut self, sample: Resource<Sample>) -> wasmtime::Result<Identity> {
        Ok(identity(&self.resolve(&sample)?.identity()))
    }

    fn stamps(&mut self, sample: Resource<Sample>) -> wasmtime::Result<Stamps> {
        Ok(stamps(self.resolve(&sample)?.stamps()))
    }

    fn get(&mut self, sample: Resource<Sample>, field: Resource<Field>) -> DataResult<Value> {
        let (sample, field) = (self.handles.get(&sample)?, self.handles.get(&field)?);
        wit_result(sample.get(field).map(value))
    }

    fn number(&mut self, sample: Resource<Sample>, field: Resource<Field>) -> DataResult<f64> {
        let (sample, field) = (self.handles.get(&sample)?, self.handles.get(&field)?);
        wit_result(sample.number(field))
    }

    fn size(&mut self, sample: Resource<Sample>) -> wasmtime::Result<u64> {
        Ok(self.resolve(&sample)?.bytes().len() as u64)
    }

    fn big_endian(&mut self, sample: Resource<Sample>) -> wasmtime::Result<bool> {
        Ok(self.resolve(&sample)?.big_endian())
    }

    /// Never called: see [`add_reads_to_linker`].
    fn cdr(
        &mut self,
        sample: Resource<Sample>,
        offset: u64,
        len: u32,
    ) -> wasmtime::Result<Vec<u8>> {
        Ok(self.sample_cdr(&sample, offset, len)?.to_vec())
    }

    fn as_frame(&mut self, sample: Resource<Sample>) -> DataResult<Resource<Frame>> {
        let frame = self.handles.get(&sample)?.as_frame();
        self.push_result(frame)
    }

    fn drop(&mut self, sample: Resource<Sample>) -> wasmtime::Result<()> {
        self.handles.delete(sample)?;
        Ok(())
    }
}

impl HostFrame for Hosted {
    fn info(&mut self, frame: Resource<Frame>) -> wasmtime::Result<FrameInfo> {
        let frame = self.resolve(&frame)?;
        let frame::Info { width, height, encoding, step, big_endian } = frame.info();
        let size = frame.bytes().len() as u64;
        Ok(FrameInfo { width, height, encoding: encoding_out(encoding), step, big_endian, size })
    }

    fn identity(&mut self, frame: Resource<Frame>) -> wasmtime::Result<Identity> {
        Ok(identity(self.resolve(&frame)?.identity()))
    }

    fn stamps(&mut self, frame: Resource<Frame>) -> wasmtime::Result<Stamps> {
        Ok(stamps(self.resolve(&frame)?.stamps()))
    }

    fn mean_luma(&mut self, frame: Resource<Frame>, roi: Option<Roi>) -> DataResult<f64> {
        wit_result(self.handles.get(&frame)?.mean_luma(roi.map(roi_in)))
    }

    fn histogram(&mut self, frame: Resource<Frame>, roi: Option<Roi>) -> DataResult<Vec<u32>> {
        wit_result(self.handles.get(&frame)?.histogram(roi.map(roi_in)).map(Vec::from))
    }

    fn resize(
        &mut self,
        frame: Resource<Frame>,
        width: u32,
        height: u32,
    ) -> DataResult<Resource<Frame>> {
        let resized = self.handles.get(&frame)?.resize(width, height);
        self.push_result(resized)
    }

    fn to_gray(&mut self, frame: Resource<Frame>) -> DataResult<Resource<Frame>> {
        let gray = self.handles.get(&frame)?.to_gray();
        self.push_result(gray)
    }

    /// Never called: see [`add_reads_to_linker`].
    fn read(&mut self, frame: Resource<Frame>, offset: u64, len: u32) -> wasmtime::Result<Vec<u8>> {
        Ok(self.frame_read(&frame, offset, len)?.to_vec())
    }

    fn drop(&mut self, frame: Resource<Frame>) -> wasmtime::Result<()> {
        self.handles.delete(frame)?;
        Ok(())
    }
}

/// Redefines the functions that return bytes, so that these are copied once, from their slot into
/// the guest's memory: the generated functions need a `Vec`.
pub(super) fn add_reads_to_linker(linker: &mut Linker<Hosted>) -> wasmtime::Result<()> {
    linker.allow_shadowing(true);
    let mut data = linker.instance(DATA)?;
    data.func_wrap(
        "[method]sample.cdr",
        |mut store, (sample, offset, len): (Resource<Sample>, u64, u32)| {
            Ok((store.data_mut().sample_cdr(&sample, offset, len)?,))
        },
    )?;
    data.func_wrap(
        "[method]frame.read",
        |mut store, (frame, offset, len): (Resource<Frame>, u64, u32)| {
            Ok((store.data_mut().frame_read(&frame, offset, len)?,))
        },
    )?;
    linker.allow_shadowing(false);
    Ok(())
}

impl Hosted {
    fn sample_cdr(
        &mut self,
        sample: &Resource<Sample>,
        offset: u64,
        len: u32,
    ) -> wasmtime::Result<Bytes> {
        Ok(Bytes::from_owner(self.handles.get(sample)?.cdr(offset, len)?))
    }

    fn frame_read(
        &mut self,
        frame: &Resource<Frame>,
        offset: u64,
        len: u32,
    ) -> wasmtime::Result<Bytes> {
        Ok(Bytes::from_owner(self.handles.get(frame)?.read(offset, len)?))
    }

    fn push_result<T: Send + 'static>(
        &mut self,
        result: Result<T, data::DataError>,
    ) -> DataResult<Resource<T>> {
        Ok(match wit_result(result)? {
            Ok(value) => Ok(self.handles.push(value)?),
            Err(refused) => Err(refused),
        })
    }

    fn push_all(&mut self, samples: Vec<Sample>) -> wasmtime::Result<Vec<Resource<Sample>>> {
        samples.into_iter().map(|sample| Ok(self.handles.push(sample)?)).collect()
    }

    /// Resolves a handle for a call that only reads a value, and charges the call, which is charged
    /// nowhere else.
    pub(super) fn resolve<T: 'static>(&self, handle: &Resource<T>) -> wasmtime::Result<&T> {
        self.session.fuel().charge_call()?;
        Ok(self.handles.get(handle)?)
    }
}

/// Converts a result for the guest. Errors for lack of fuel, time or holds end the guest.
fn wit_result<T>(result: Result<T, data::DataError>) -> DataResult<T> {
    match result {
        Ok(value) => Ok(Ok(value)),
        Err(data::DataError::OutOfFuel(error)) => Err(error.into()),
        Err(error @ (data::DataError::OutOfTime | data::DataError::OutOfHolds { .. })) => {
            Err(error.into())
        }
        Err(error) => Ok(Err(refused(error))),
    }
}

fn column_out(data::Column { at_ns, values }: data::Column) -> Column {
    Column { at_ns, values }
}

fn identity(data::Identity { topic, writer, seq }: &data::Identity) -> Identity {
    let bytes = u128::from_be_bytes(writer.0);
    let writer = Guid { high: (bytes >> 64) as u64, low: bytes as u64 };
    Identity { topic: topic.clone(), writer, seq: *seq }
}

fn stamps(data::Stamps { at_ns, publish_ns, header_ns }: data::Stamps) -> Stamps {
    Stamps { at_ns, publish_ns, header_ns }
}

fn roi_in(Roi { x, y, width, height }: Roi) -> image::Roi {
    image::Roi { x, y, width, height }
}

fn value(value: gleaner_messages::MessageValue<'_>) -> Value {
    use gleaner_messages::MessageValue as Read;
    match value {
        Read::Bool(value) => Value::Boolean(value),
        Read::Signed(value) => Value::Signed(value),
        Read::Unsigned(value) => Value::Unsigned(value),
        Read::Real(value) => Value::Real(value),
        Read::Text(value) => Value::Text(value.to_owned()),
        Read::Bytes(value) => Value::Bytes(value.to_vec()),
        Read::Numbers(value) => Value::Numbers(value),
        Read::Texts(value) => Value::Texts(value.into_iter().map(str::to_owned).collect()),
    }
}

fn refused(error: data::DataError) -> DataError {
    let message = error.to_string();
    match error.kind() {
        Kind::NoSuchInput => DataError::NoSuchInput(message),
        Kind::NoSuchField => DataError::NoSuchField(message),
        Kind::WrongField => DataError::WrongField(message),
        Kind::Malformed => DataError::Malformed(message),
        Kind::NotAFrame => DataError::NotAFrame(message),
        Kind::NoRoom => DataError::NoRoom(message),
        Kind::OutOfRange => DataError::OutOfRange(message),
    }
}

fn encoding_out(encoding: image::Encoding) -> Encoding {
    use image::{Bayer, Encoding as E};
    match encoding {
        E::Rgb8 => Encoding::Rgb8,
        E::Bgr8 => Encoding::Bgr8,
        E::Rgba8 => Encoding::Rgba8,
        E::Bgra8 => Encoding::Bgra8,
        E::Mono8 => Encoding::Mono8,
        E::Mono16 => Encoding::Mono16,
        E::Yuv422Uyvy => Encoding::Yuv422,
        E::Yuv422Yuyv => Encoding::Yuv422Yuy2,
        E::Bayer8(Bayer::Rggb) => Encoding::BayerRggb8,
        E::Bayer8(Bayer::Bggr) => Encoding::BayerBggr8,
        E::Bayer8(Bayer::Gbrg) => Encoding::BayerGbrg8,
        E::Bayer8(Bayer::Grbg) => Encoding::BayerGrbg8,
        E::Bayer16(Bayer::Rggb) => Encoding::BayerRggb16,
        E::Bayer16(Bayer::Bggr) => Encoding::BayerBggr16,
        E::Bayer16(Bayer::Gbrg) => Encoding::BayerGbrg16,
        E::Bayer16(Bayer::Grbg) => Encoding::BayerGrbg16,
    }
}
