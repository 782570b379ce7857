//! The program `gleaner-inference`, with lambdas in this process.

mod ending;
mod hostile;
mod onnx_runtime;
mod parity;
mod refusing;
mod running;
mod sharing;
mod support;
