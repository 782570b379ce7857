//! The list. When a line is added here, the compiler and the tests report what is missing
//! elsewhere.

use super::Deadline::{self, Checked, Short, Waiting};
use super::Price::{self, Bytes, Never};
use super::{MESSAGE, PIXELS, PricedCall};

/// Each line: the name in Rust, the name in the WIT, the handling of the deadline, and the price
/// after [`super::setup`].
macro_rules! operations {
    ($($operation:ident $name:literal $deadline:ident $price:expr;)*) => {
        /// A function or a method of the WIT. Those that others depend on come first, so that small
        /// numbers in fuzz inputs reach them.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Operation { $($operation),* }

        impl Operation {
            pub const ALL: &[Self] = &[$(Self::$operation),*];

            /// Interface, resource and function in the WIT.
            pub fn name(self) -> &'static str {
                match self { $(Self::$operation => $name),* }
            }

            /// Its handling of the deadline.
            pub fn deadline(self) -> Deadline {
                match self { $(Self::$operation => $deadline),* }
            }

            pub fn price(self) -> Price {
                match self { $(Self::$operation => $price),* }
            }
        }
    };
}

/// A call with these arguments, which touches this many bytes.
const fn call(arguments: &'static [u8], bytes: u64) -> PricedCall {
    PricedCall { arguments, bytes }
}

/// The same price for every call.
const fn each(arguments: &'static [u8], bytes: u64) -> Price {
    Bytes([call(arguments, bytes), call(arguments, bytes)])
}

operations! {
    Input "data.input" Short Bytes([call(&[3, 1, b'x'], 1), call(&[3, 255, 0, 16, 0, 0], 4096)]);
    Newest "data.topic.newest" Short each(&[1], 0);
    AsFrame "data.sample.as-frame" Checked Bytes([call(&[0], 0), call(&[1], 40 * PIXELS)]);
    Field "data.topic.field" Short
        Bytes([call(&[1, 1, 1, b'x'], 1), call(&[1, 1, 255, 232, 3, 0, 0], 1000)]);
    Last "data.topic.last" Short Bytes([call(&[1, 0, 0, 0, 0], 0), call(&[1, 4, 0, 0, 0], 4 * 64)]);
    Since "data.topic.since" Short
        Bytes([call(&[1, 0, 0, 0, 0, 0, 0, 0, 127], 0), call(&[1], 4 * 64)]);
    Column "data.topic.column" Checked
        Bytes([call(&[1, 0, 1, 0, 0, 0], 64), call(&[1, 0, 4, 0, 0, 0], 4 * 64)]);
    ColumnSince "data.topic.column-since" Checked
        Bytes([call(&[1, 0, 0, 0, 0, 0, 0, 0, 0, 127], 0), call(&[1, 0], 4 * 64)]);
    Name "data.topic.name" Short each(&[1], 0);
    RosTopic "data.topic.ros-topic" Short each(&[1], 0);
    TypeName "data.topic.type-name" Short each(&[1], 0);
    TopicCounts "data.topic.counts" Short each(&[1], 0);
    FieldPath "data.field.path" Short each(&[0], 0);
    SampleIdentity "data.sample.identity" Short each(&[0], 0);
    SampleStamps "data.sample.stamps" Short each(&[0], 0);
    Size "data.sample.size" Short each(&[0], 0);
    MeanLuma "data.frame.mean-luma" Checked
        Bytes([call(&[0, 2, 2, 3, 8, 1], 24), call(&[0, 0], PIXELS)]);
    BigEndian "data.sample.big-endian" Short each(&[0], 0);
    Get "data.sample.get" Short each(&[0, 0], MESSAGE);
    Number "data.sample.number" Short each(&[0, 0], 64);
    Cdr "data.sample.cdr" Short
        Bytes([call(&[0], 0), call(&[0, 0, 0, 0, 0, 0, 0, 0, 0, 64, 31, 0, 0], 8000)]);
    Info "data.frame.info" Short each(&[0], 0);
    FrameIdentity "data.frame.identity" Short each(&[0], 0);
    FrameStamps "data.frame.stamps" Short each(&[0], 0);
    Histogram "data.frame.histogram" Checked
        Bytes([call(&[0, 2, 2, 3, 8, 1], 8 * 24), call(&[0, 0], 8 * PIXELS)]);
    Resize "data.frame.resize" Checked
        Bytes([call(&[0, 0, 1, 1], 29_232), call(&[0, 1, 32, 0, 0, 0, 24, 0, 0, 0], 101_376)]);
    ToGray "data.frame.to-gray" Checked each(&[0], 4 * PIXELS);
    Read "data.frame.read" Short
        Bytes([call(&[0], 0), call(&[0, 0, 0, 0, 0, 0, 0, 0, 0, 64, 31, 0, 0], 8000)]);
    Inputs "data.inputs" Short each(&[], 3 * 64);
    NowNs "data.now-ns" Short each(&[], 0);
    Event "trigger.event" Short Bytes([call(&[1, b'e'], 1), call(&[255, 0, 16, 0, 0], 4096)]);
    // With an attribute: 64 bytes, one for its key, and 8 for its value.
    Start "trigger.start" Short Bytes([call(&[1, b's'], 74), call(&[255, 0, 16, 0, 0], 4096 + 73)]);
    Stop "trigger.stop" Short Bytes([call(&[1, b's'], 1), call(&[255, 0, 16, 0, 0], 4096)]);
    Log "log.log" Short Bytes([call(&[1, 1, b'l'], 1), call(&[1, 255, 0, 16, 0, 0], 4096)]);
    // Four bytes for each dimension, and those of the tensor.
    TensorCreate "inference.tensor.create" Short
        Bytes([call(&[0, 0, 1, 1], 8 + 4), call(&[0, 0, 32, 32], 8 + 4096)]);
    FromFrame "inference.tensor.from-frame" Checked
        Bytes([call(&[0, 0, 8, 8], 12 * 8 * 8), call(&[0, 0, 64, 64], 12 * 64 * 64)]);
    Element "inference.tensor.element" Short each(&[0], 0);
    Shape "inference.tensor.shape" Short each(&[0], 0);
    TensorSize "inference.tensor.size" Short each(&[0], 0);
    TensorRead "inference.tensor.read" Short
        Bytes([call(&[0], 0), call(&[0, 0, 0, 0, 0, 0, 0, 0, 0, 160, 15, 0, 0], 4000)]);
    TensorWrite "inference.tensor.write" Short
        Bytes([call(&[0], 0), call(&[0, 0, 0, 0, 0, 0, 0, 0, 0, 160, 15, 0, 0], 4000)]);
    Open "inference.model.open" Waiting
        Bytes([call(&[1, b'm'], 1), call(&[255, 0, 16, 0, 0], 4096)]);
    ModelInputs "inference.model.inputs" Short Never;
    ModelOutputs "inference.model.outputs" Short Never;
    Labels "inference.model.labels" Short Never;
    Runtime "inference.model.runtime" Short Never;
    Run "inference.model.run" Waiting Never;
    Detect "inference.model.detect" Waiting Never;
    ScratchPut "scratch.put" Short
        Bytes([call(&[0, 0, 0, 0, 0], 1), call(&[0, 0, 16, 0, 0], 1 + 4096)]);
    Append "scratch.append" Short Bytes([call(&[0, 0, 0], 1), call(&[0, 0, 16], 1 + 4096)]);
    ScratchGet "scratch.get" Short
        Bytes([call(&[1], 1), call(&[1, 0, 0, 0, 0, 0, 0, 0, 0, 160, 15, 0, 0], 1 + 4000)]);
    Remove "scratch.remove" Short Bytes([call(&[2], 1), call(&[4], 9)]);
    Entries "scratch.entries" Short each(&[], 64 + 1);
    Free "scratch.free" Short each(&[], 0);
}
