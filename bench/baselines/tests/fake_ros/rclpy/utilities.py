def get_rmw_implementation_identifier() -> str:
    return "rmw_fake_cpp"
