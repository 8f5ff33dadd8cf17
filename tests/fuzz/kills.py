def run(case, folder): raise NotImplementedError
