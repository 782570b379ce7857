//! Messages between `gleaner-orchestrator`, which decides what runs on a vehicle, and
//! `gleaner-supervisor`, which keeps it running: lines of JSON over a socket.
//!
//! The orchestrator sends the whole desired state, and the supervisor its whole status. So neither
//! has to know what the other one missed while it did not run.

mod event;
mod request;
mod status;

pub use event::{EventKind, VehicleEvent};
pub use request::{
    DesiredLambda, DesiredState, LAMBDAS_MAX, SUPERVISION_VERSION, SupervisionSpec,
    SupervisorRequest,
};
pub use status::{
    ClipCounts, LambdaPhase, LambdaStatus, ProcessStatus, SupervisorReport, SupervisorStatus,
    Welcome,
};
