//! The program `gleaner-inference`, with lambdas in this process.

mod ending;
mod hostile;
mod onnx;
mod onnx_runtime;
mod parity;
mod refusing;
mod running;
#[path = "../../../../base/src/shared_data.rs"]
mod shared_data;
mod sharing;
mod support;
