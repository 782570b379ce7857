//! `gleaner:lambda/inference` over [`api::inference`](crate::api::inference).

use wasmtime::component::Resource;

use super::Hosted;
use super::bindings::gleaner::lambda::inference::{
    DetectOptions, Detection, Host, HostModel, HostTensor, InferenceError, Preprocess,
};
use crate::api::frame::Frame;
use crate::api::inference::{self, InferenceErrorKind, Model, Tensor};

type InferenceResult<T> = wasmtime::Result<Result<T, InferenceError>>;

impl Host for Hosted {}

impl HostTensor for Hosted {
    fn from_values(
        &mut self,
        shape: Vec<u32>,
        values: Vec<f32>,
    ) -> InferenceResult<Resource<Tensor>> {
        let result =
            Tensor::from_values(size_of_val(&*shape) + size_of_val(&*values), self.session.fuel());
        self.push_model_result(result)
    }

    fn from_frame(
        &mut self,
        _frame: Resource<Frame>,
        _how: Preprocess,
    ) -> InferenceResult<Resource<Tensor>> {
        let result = Tensor::from_frame(self.session.fuel());
        self.push_model_result(result)
    }

    fn shape(&mut self, tensor: Resource<Tensor>) -> wasmtime::Result<Vec<u32>> {
        match *self.handles.get(&tensor)? {}
    }

    fn read(
        &mut self,
        tensor: Resource<Tensor>,
        _offset: u64,
        _len: u32,
    ) -> wasmtime::Result<Vec<f32>> {
        match *self.handles.get(&tensor)? {}
    }

    fn drop(&mut self, tensor: Resource<Tensor>) -> wasmtime::Result<()> {
        match self.handles.delete(tensor)? {}
    }
}

impl HostModel for Hosted {
    fn open(&mut self, name: String) -> InferenceResult<Resource<Model>> {
        let opened = Model::open(&name, self.session.fuel());
        self.push_model_result(opened)
    }

    fn run(
        &mut self,
        model: Resource<Model>,
        _inputs: Vec<Resource<Tensor>>,
    ) -> InferenceResult<Vec<Resource<Tensor>>> {
        match *self.handles.get(&model)? {}
    }

    fn detect(
        &mut self,
        model: Resource<Model>,
        _frame: Resource<Frame>,
        _options: DetectOptions,
    ) -> InferenceResult<Vec<Detection>> {
        match *self.handles.get(&model)? {}
    }

    fn drop(&mut self, model: Resource<Model>) -> wasmtime::Result<()> {
        match self.handles.delete(model)? {}
    }
}

impl Hosted {
    fn push_model_result<T: Send + 'static>(
        &mut self,
        result: Result<T, inference::InferenceError>,
    ) -> InferenceResult<Resource<T>> {
        let error = match result {
            Ok(value) => return Ok(Ok(self.handles.push(value)?)),
            Err(inference::InferenceError::OutOfFuel(error)) => return Err(error.into()),
            Err(error) => error,
        };
        Ok(Err(match error.kind() {
            InferenceErrorKind::NoRuntime => InferenceError::NoRuntime(error.to_string()),
        }))
    }
}
