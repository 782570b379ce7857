//! Tests of the public interface: tensors against a slow reference, detections against boxes worked
//! out by hand, and both against pictures and models of others.

mod data;
mod detect;
mod prepare;
